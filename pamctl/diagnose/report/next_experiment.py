"""The questions that the records leave open, and the experiment that would answer more."""

from __future__ import annotations

from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.experiments import find_separating_experiment, find_showing_experiment
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.rig_at_hand import advise_experiment

NEARLY_SEEN = 3.0
"""An effect visible from this many smallest sizes on needs no other experiment."""


def list_blind_spots(diagnosis: Diagnosis) -> list[dict[str, object]]:
    """Return the effects that these records could not have shown."""
    audit = diagnosis.audit
    return [spot.as_dict() for spot in audit.blind_spots] if audit else []


def choose_next_experiment(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """Return the experiment that would answer more, if there is one.

    `do` is the command that runs it, or says what to record on a rig that pamctl does not run.
    """
    experiment = _choose_experiment(diagnosis)
    if experiment is None:
        return None
    return {**experiment, "do": advise_experiment(diagnosis, str(experiment["name"]))}


def _choose_experiment(diagnosis: Diagnosis) -> dict[str, Any] | None:
    sets = [[s.effect.name, *s.equal_rivals] for s in diagnosis.standings if s.equal_rivals]
    if sets:
        return find_separating_experiment(sets[0])
    if diagnosis.verdict in (Verdict.PARTIAL, Verdict.NONE_KNOWN):
        return {
            "name": "diagnosis",
            "separates": [],
            "why": "a full program shows in which regime the remainder lies",
        }
    spots = [s for s in diagnosis.audit.blind_spots if s.experiment] if diagnosis.audit else []
    hidden = max(spots, key=lambda s: s.sizes, default=None)
    return find_showing_experiment(hidden.name) if hidden and hidden.sizes > NEARLY_SEEN else None
