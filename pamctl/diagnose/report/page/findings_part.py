"""The findings with gain, rivals and numbers; the faults of the set-up; the model's own numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.plant_numbers import FittedNumber, look_up_parameter
from pamctl.diagnose.report.finding_words import (
    FreeTerm,
    is_in_catalogue,
    label_hypothesis,
    list_numbers,
    spell_finding,
    spell_kind,
    spell_names,
    spell_place,
)
from pamctl.diagnose.report.open_findings import list_faults
from pamctl.diagnose.report.phrases import relative_shift
from pamctl.plant.catalogue import CATALOGUE
from pamctl.report.drawing.levels import Levels
from pamctl.report.drawing.svg import MUTED
from pamctl.report.html_page import Page

MOST_RIVALS = 5
"""Bars of rivals below a finding's own."""
_SURE = {
    "name": "the name: every rival that was fitted in its place is beaten",
    "kind": "place and kind",
    "place": "the place",
    "set": "that one of these is there",
    "rest": "nothing: it mends the model, and is small beside what was found before it",
}


def write_setup(page: Page, diagnosis: Diagnosis) -> None:
    """Write what is wrong about the set-up, and how to mend it."""
    faults = list_faults(diagnosis)
    if not faults:
        return
    page.section("The set-up")
    page.table(
        ["what is wrong", "value", "90 % interval", "unit", "not told from"],
        [
            [
                fault.text,
                f"{fault.value:.5g}",
                f"{fault.ci90[0]:.5g} to {fault.ci90[1]:.5g}",
                fault.unit,
                ", ".join(map(spell_names, fault.cannot_be_told_from)) or "-",
            ]
            for fault in faults
        ],
        caption="Each is a number of the plant file or a column of the records. It was asked "
        "together with the effects, and by the same rule.",
    )
    page.points(*(f"To mend it: {fault.how_to_mend}." for fault in faults))


def write_findings(page: Page, diagnosis: Diagnosis) -> None:
    """Write each finding with its rivals and numbers, then the numbers that were recalibrated."""
    if diagnosis.findings:
        page.section("What was found")
        page.text(
            "A gain is counted in nats, on each block of the records by a model that was not "
            "fitted to that block. It is counted under the resolution of the poorer of two models. "
            "Intervals come from a bootstrap over stretches of 4 blocks, 0.5 % on each side."
        )
    for finding in diagnosis.findings:
        _write_finding(page, diagnosis, finding)
    if diagnosis.recalibrated:
        page.section("The numbers of the model")
        page.table(
            ["parameter", "start model", "fitted", "90 % interval", "unit", "off by", "range"],
            list(_list_recalibrated(diagnosis)),
            caption="Fitted together with all findings. A number is off if its interval does not "
            "include the start model's value. A number at an end of its range may lie beyond it.",
        )


def _write_finding(page: Page, diagnosis: Diagnosis, finding: Finding) -> None:
    its = finding.hypothesis
    page.heading(spell_finding(diagnosis, finding))
    page.facts(
        {
            "what is sure": _SURE[finding.level],
            "place": spell_place(its.place),
            "kind": spell_kind(its.kind),
            "fits best": label_hypothesis(its),
            "share of the whole gain": f"{100.0 * finding.share:.0f} %",
        }
    )
    if is_in_catalogue(finding):
        effect = CATALOGUE[its.family]
        page.note(effect.equation)
        page.text(f"What a model without it shows: {effect.signature}.")
    term = FreeTerm.read(diagnosis, finding) if its.is_term else None
    if term is not None:
        kin = f" Kin in the catalogue: {spell_names(*term.kin)}." if term.kin else ""
        page.note(f"{term.text[:1].upper()}{term.text[1:]}. {term.equation}.{kin}")
    page.grid(_draw_rivals(finding), caption=_write_caption(finding))
    page.table(
        ["number", "meaning", "value", "90 % interval", "unit", "range"],
        [_number_row(finding, n) for n in list_numbers(finding)],
    )
    if term is not None and term.curve:
        unit = "" if term.location.unit == "1" else f", {term.location.unit}"
        driver = f"{term.driver}, {term.as_dict([])['driver_unit']}"
        page.table(
            [driver, f"size{unit}", "90 % interval"],
            [
                [f"{p['at']:.4g}", f"{p['value']:.4g}", " to ".join(f"{e:.4g}" for e in p["ci90"])]
                for p in term.curve
            ],
            caption="The curve: linear between these points, and constant beyond them. What "
            "recalibration imitates may move the whole of it.",
        )


def _draw_rivals(finding: Finding) -> Levels:
    plot = Levels("Lost without it, and with a rival in its place", "nats")
    plot.bar("without it", finding.gain_nats, ends=finding.interval_nats)
    for j in finding.judged[:MOST_RIVALS]:
        colour = 1 if j.is_beaten else MUTED if j.is_freer else 3
        label = spell_names(label_hypothesis(j.hypothesis))
        plot.bar(label, j.behind_nats, colour=colour, ends=j.interval_nats)
    return plot


def _write_caption(finding: Finding) -> str:
    if not finding.judged:
        return "No rival came near enough to be fitted in its place."
    shown = finding.judged[:MOST_RIVALS]
    near = sum(not j.is_beaten and not j.is_freer for j in shown)
    mimics = sum(not j.is_beaten and j.is_freer for j in shown)
    left = f"{near} of these cannot be ruled out." if near else ""
    freer = (
        "The grey bar is a freer law of the same place: it can always mimic a name, and counts "
        "only where it does better."
        if mimics
        else ""
    )
    return (
        "Each rival was fitted in its place, beside the rest of the model. A rival is beaten if it "
        f"surely loses a tenth of what is lost without the finding. {left} {freer}".rstrip()
    )


def _number_row(finding: Finding, n: FittedNumber) -> list[str]:
    meaning = look_up_parameter(n.name).meaning if is_in_catalogue(finding) else "-"
    ends = [f"{n.value:.5g}", f"{n.low:.5g} to {n.high:.5g}", n.unit]
    return [n.name.lstrip("~"), meaning, *ends, "at an end" if n.name in finding.at_range else ""]


def _list_recalibrated(diagnosis: Diagnosis) -> Iterator[Sequence[str]]:
    for n in diagnosis.recalibrated:
        off = relative_shift(diagnosis, n)
        yield [
            n.name,
            f"{diagnosis.start_value(n.name):.5g}",
            f"{n.value:.5g}",
            f"{n.low:.5g} to {n.high:.5g}",
            n.unit,
            f"{100.0 * off:+.2f} %" if off is not None else "-",
            "at an end" if n.name in diagnosis.at_bound else "",
        ]
