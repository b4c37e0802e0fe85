"""One round on the rig: what was run and why, what it showed, how far the rig repeated itself."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.deciding.drawn_programs import REST_S, STROKES, STROKES_HZ
from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.verdict_words import sentence

SAME_V = 1e-3
"""Commands that differ by less are the same."""
FEWEST_SHARE = 0.9
"""Share of the ticks that both records must have, with the same command."""
REPEATED_S = REST_S + STROKES / STROKES_HZ


@dataclass(frozen=True)
class RepeatDifference:
    """How far the part that all programs share differs from the first time, by channel, in SI."""

    channel: str
    rms: float
    noise: float
    """What two readings of an unchanged rig differ by."""

    def as_dict(self) -> dict[str, Any]:
        """Return what the document holds."""
        return {"rms": self.rms, "noise": self.noise}


@dataclass(frozen=True)
class RigRound:
    """One program on the rig, and the diagnosis of all records so far."""

    number: int
    program: str
    why: str
    log: str
    rig_time_s: float
    """Homing, program and rest."""
    diagnosis: Diagnosis
    repeated: tuple[RepeatDifference, ...]

    @property
    def left(self) -> tuple[str, ...]:
        """The explanations that the data leave open; one where they are decided."""
        return self.diagnosis.explanations

    def as_dict(self) -> dict[str, Any]:
        """Return what the document holds."""
        return {
            "round": self.number,
            "program": self.program,
            "why": self.why,
            "log": self.log,
            "rig_time_s": round(self.rig_time_s, 3),
            "verdict": self.diagnosis.verdict.value,
            "sentence": sentence(self.diagnosis),
            "explanations_left": [*self.left],
            "forecasts": [f.as_dict() for f in self.diagnosis.forecasts if f.record == self.log],
            "repeated_part": {d.channel: d.as_dict() for d in self.repeated},
        }


def compare_repeated_part(
    first: Record, again: Record, diagnosis: Diagnosis
) -> tuple[RepeatDifference, ...]:
    """Return by how much the shared beginning of two records differs; empty if not shared."""
    if first is again or diagnosis.evidence is None:
        return ()
    one, other = _match_ticks(first, again)
    same = np.abs(first["valve_v"][one] - again["valve_v"][other]) <= SAME_V
    if len(one) < FEWEST_SHARE * REPEATED_S / first.period_s or same.mean() < FEWEST_SHARE:
        return ()
    differences = {
        channel: again[channel][other][same] - first[channel][one][same]
        for channel in ("pressure_pa", "position_m")
    }
    return tuple(
        RepeatDifference(
            channel,
            float(np.sqrt(np.mean(off**2))),
            sqrt(2.0) * diagnosis.evidence.noise_rms[channel],
        )
        for channel, off in differences.items()
    )


def _match_ticks(first: Record, again: Record) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the samples of both records that belong to the same ticks of the shared part."""
    ticks, others = (np.rint(r.t_s / first.period_s) for r in (first, again))
    shared, one, other = np.intersect1d(ticks, others, return_indices=True)
    within = shared * first.period_s < REPEATED_S
    return one[within], other[within]
