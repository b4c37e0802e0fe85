"""Phrases about described terms and leads that terminal, document and page share."""

from __future__ import annotations

from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.terms.describe import DescribedTerm

MOST_NAMED = 3


def find_term(diagnosis: Diagnosis) -> DescribedTerm | None:
    """Return the term that was described; None where there is none."""
    return diagnosis.described.term if diagnosis.described else None


def describe_kin(term: DescribedTerm) -> str:
    """Name the effects that a term resembles; empty where there are none."""
    return f"; kin: {', '.join(name.replace('_', ' ') for name in term.kin)}" if term.kin else ""


def describe_equals(term: DescribedTerm) -> str:
    """Name the terms that the data do not tell from it; empty where there are none."""
    if not term.equals:
        return ""
    first = "; or ".join(term.equals[:MOST_NAMED])
    more = len(term.equals) - MOST_NAMED
    also = f"; or {more} more" if more > 0 else ""
    return f" These data do not tell it from: {first}{also}."


def describe_questions(diagnosis: Diagnosis) -> str:
    """Say how many questions were asked, and what they find in nothing; empty where none were."""
    about = diagnosis.described
    if about is None:
        return ""
    return (
        f"{about.asked} terms were asked. In a residual with nothing in it the best of them "
        f"predicts {100.0 * about.by_chance:.0f} % of the square."
    )


def describe_leads(diagnosis: Diagnosis) -> str:
    """Name the terms that come nearest, where none is described; empty where there are none."""
    about = diagnosis.described
    if about is None or about.term is not None or not about.leads:
        return ""
    first = about.leads[0]
    return (
        f"A lead, not a finding: {first.text} leaves {first.residual_over_floor:.1f} times the "
        "floor."
    )


def list_term_entries(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the described terms as the document holds them."""
    term = find_term(diagnosis)
    if term is None or diagnosis.described is None:
        return []
    return [
        {
            "text": term.text,
            "location": term.location,
            "operator": term.operator,
            "driver": term.driver,
            "block": term.block,
            "unit": term.unit,
            "driver_unit": term.driver_unit,
            "equation": term.equation,
            "parameters": {n.name.split(".")[1]: n.as_dict() for n in term.numbers},
            "curve": [{"at": p.at, "value": p.value, "ci90": [p.low, p.high]} for p in term.curve],
            "kin": [*term.kin],
            "cannot_be_told_from": [*term.equals],
            "closed": term.closed,
        }
    ]


def list_lead_entries(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the leads as the document holds them."""
    about = diagnosis.described
    return [
        {
            "text": lead.text,
            "location": lead.location,
            "operator": lead.operator,
            "driver": lead.driver,
            "residual_over_floor": lead.residual_over_floor,
            "explained": lead.explained,
        }
        for lead in (about.leads if about else ())
    ]
