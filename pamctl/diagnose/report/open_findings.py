"""The findings sorted by what a reader does with them: effects, faults, laws, places, sets."""

from __future__ import annotations

from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.report.finding_words import (
    FreeTerm,
    is_in_catalogue,
    label_hypothesis,
    list_candidates,
    spell_finding,
)
from pamctl.diagnose.report.setup_words import SetupFault

BEST_KNOWN = ("name", "set")
"""Levels at which the best hypothesis itself is shown: alone, or first of its set."""


def list_effects(diagnosis: Diagnosis) -> list[Finding]:
    """Return the findings that are effects of the catalogue, named or first of a set."""
    return [f for f in diagnosis.findings if f.level in BEST_KNOWN and is_in_catalogue(f)]


def list_faults(diagnosis: Diagnosis) -> list[SetupFault]:
    """Return the faults of the set-up, named or first of a set."""
    return [
        SetupFault.read(diagnosis, f, list_candidates(f)[1:] if f.level == "set" else [])
        for f in diagnosis.findings
        if f.level in BEST_KNOWN and f.hypothesis.setup
    ]


def list_terms(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the laws without a name whose place and kind are sure, as the document has them."""
    return [
        FreeTerm.read(diagnosis, f).as_dict(list(map(label_hypothesis, f.rivals)))
        for f in diagnosis.findings
        if f.level == "kind" and f.hypothesis.is_term
    ]


def list_places(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return what is sure by its place only, or by place and kind where no free law is shown."""
    return [
        {
            "place": f.hypothesis.place,
            "kind": f.hypothesis.kind if f.level == "kind" else None,
            "text": spell_finding(diagnosis, f),
            "candidates": list_candidates(f),
        }
        for f in diagnosis.findings
        if f.level == "place" or (f.level == "kind" and not f.hypothesis.is_term)
    ]


def list_ambiguous(diagnosis: Diagnosis) -> list[list[str]]:
    """Return the sets of which one member is true, each with its best member first."""
    return [list_candidates(f) for f in diagnosis.findings if f.level == "set"]
