"""What the records leave open, and the experiment that would tell more."""

from __future__ import annotations

from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.experiments import separating, showing
from pamctl.diagnose.naming.verdict import Verdict

NEARLY_SEEN = 3.0
"""What shows from so many smallest sizes on is no reason for another experiment."""


def ambiguous(diagnosis: Diagnosis) -> list[list[str]]:
    """Return the sets of effects that the data do not tell apart."""
    return [[s.effect.name, *s.equals] for s in diagnosis.standings if s.equals]


def blind_spots(diagnosis: Diagnosis) -> list[dict[str, object]]:
    """Return what these records could not have shown."""
    audit = diagnosis.audit
    return [spot.as_dict() for spot in audit.blind_spots] if audit else []


def next_experiment(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """Return the experiment that would tell more, if there is one."""
    sets = ambiguous(diagnosis)
    if sets:
        return separating(sets[0])
    if diagnosis.verdict in (Verdict.PARTIAL, Verdict.NONE_KNOWN):
        return {
            "name": "diagnosis",
            "separates": [],
            "why": "the whole program, to see in which regime the remainder lies",
        }
    spots = [s for s in diagnosis.audit.blind_spots if s.experiment] if diagnosis.audit else []
    hidden = max(spots, key=lambda s: s.sizes, default=None)
    return showing(hidden.name) if hidden and hidden.sizes > NEARLY_SEEN else None
