"""The described term with its curve, and the leads."""

from __future__ import annotations

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.report.term_phrases import describe_questions, find_term
from pamctl.diagnose.terms.describe import DescribedTerm
from pamctl.report.html_page import Page


def write_terms(page: Page, diagnosis: Diagnosis) -> None:
    """Write what no catalogue has: the term that is described, then the leads."""
    about, term = diagnosis.described, find_term(diagnosis)
    if about is None or not (term or about.leads):
        return
    page.section("What no catalogue has")
    if term is not None:
        _write_term(page, term)
    page.table(
        ["term", "left, x floor", "of the square, before the fit"],
        [
            [lead.text, f"{lead.residual_over_floor:.2f}", f"{100.0 * lead.explained:.0f} %"]
            for lead in about.leads
        ],
        caption="Terms that were fitted in the plant, the best first. "
        f"{describe_questions(diagnosis)} A term that is not in the verdict is a lead: it says "
        "where to look, and is no finding.",
    )


def _write_term(page: Page, term: DescribedTerm) -> None:
    page.heading(term.text)
    page.facts(
        {
            "place, operator, driver": f"{term.location}, {term.operator}, {term.driver}",
            "equation": term.equation,
            "kin in the catalogue": ", ".join(term.kin) or "none",
            "closes": f"{100.0 * term.closed:.0f} % of the {term.block} block's gap",
        }
    )
    if term.equals:
        page.note(f"These data do not tell it from: {'; or '.join(term.equals)}.")
    page.table(
        ["number", "fitted", "90 % interval"],
        [
            [n.name.split(".")[1], f"{n.value:.5g}", f"{n.low:.5g} to {n.high:.5g}"]
            for n in term.numbers
        ],
    )
    if term.curve:
        unit = "" if term.unit == "1" else f", {term.unit}"
        page.table(
            [f"{term.driver}, {term.driver_unit}", f"size{unit}", "90 % interval"],
            [[f"{p.at:.4g}", f"{p.value:.4g}", f"{p.low:.4g} to {p.high:.4g}"] for p in term.curve],
            caption="The curve: linear between these points. What recalibration imitates may move "
            "the whole of it.",
        )
