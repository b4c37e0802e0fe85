"""Choose the program that decides between the explanations that a diagnosis leaves.

chosen = choose_deciding_program(explanations, records)
chosen.separations       what the wrong one of two explanations would leave of its run
chosen.to_experiment()   the keys of the experiment file
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot
from typing import Any

import numpy as np

from pamctl.control.excitation import ProgramSettings
from pamctl.diagnose.deciding.drawn_programs import (
    Part,
    draw_programs,
    make_program,
    make_repeated_part,
    make_vent,
)
from pamctl.diagnose.deciding.explanations import Explanation
from pamctl.diagnose.deciding.rig_limits import RigLimits, find_rig_limits
from pamctl.diagnose.deciding.separation import ProgramTrial, Separation
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.measured.record import Record

PROGRAMS = 200
FINALISTS = 12
"""Programs whose separation is computed with the wrong explanation refitted."""
STROKES = (1.0, 0.6, 0.4, 0.2, 0.1)
"""Sizes of the strokes that all programs begin with, as shares of the largest command; the largest
that stays within the limits counts."""
CLEAR = 1.05
"""A forecast counts as a decision if the residual passes its limit by this factor."""


@dataclass(frozen=True)
class DecidingProgram:
    """The chosen program, and what is expected of it."""

    program: ProgramSettings
    explanations: tuple[str, ...]
    separations: tuple[Separation, ...]
    pressure_pa: float
    """Highest absolute pressure of all explanations."""
    low_m: float
    high_m: float
    duration_s: float
    promises: bool
    """Some pair of explanations is separated by more than the limits of their blocks."""
    drawn: int
    """Programs that were drawn."""
    inside: int
    """Those that stay within the limits."""
    limits_from: str

    @property
    def nearest(self) -> Separation:
        """The pair that is separated least."""
        return min(self.separations, key=lambda s: s.residual_over_floor)

    def to_experiment(self) -> dict[str, Any]:
        """Return the keys of the experiment file, with the forecast in it."""
        forecast = {
            "pairs": [
                {
                    "true": s.true,
                    "refuted": s.refuted,
                    "block": s.block,
                    "residual_over_floor": float(f"{s.residual_over_floor:.4g}"),
                }
                for s in self.separations
            ],
            "pressure_kpa": round(1e-3 * self.pressure_pa, 1),
            "low_mm": round(1e3 * self.low_m, 2),
            "high_mm": round(1e3 * self.high_m, 2),
        }
        keys = self.program.model_dump(mode="json", exclude_none=True)
        return {**keys, "forecast": forecast}


def choose_deciding_program(
    explanations: Sequence[Explanation],
    records: Sequence[Record],
    *,
    programs: int = PROGRAMS,
    seed: int = 0,
) -> DecidingProgram | None:
    """Return the best of `programs` drawn programs.

    None where there is nothing to decide, or no drawn program stays within the limits.
    """
    if len(explanations) < 2 or not _are_of_muscle(explanations):
        return None
    limits = find_rig_limits(records)
    period_s = float(np.median(records[0].step_s))
    begin = choose_repeated_part(explanations, limits, period_s)
    drawn = (
        ProgramTrial(program, explanations, period_s)
        for program in draw_programs(programs, limits.command_v, begin, seed)
    )
    inside = [trial for trial in drawn if all(map(limits.allows, trial.runs.values()))]
    finalists = sorted(inside, key=lambda t: t.rough, reverse=True)[:FINALISTS]
    records_s = sum(record.duration_s for record in records)

    def weigh(trial: ProgramTrial) -> tuple[int, float]:
        pairs = trial.name_pairs().values()
        return _count_promised(trial, explanations, records_s), min(pairs)

    for best in sorted(finalists, key=weigh, reverse=True):
        if _is_admitted(best, limits):
            promised = _count_promised(best, explanations, records_s) > 0
            return _describe(best, programs, len(inside), limits.source, promises=promised)
    return None


def choose_repeated_part(
    explanations: Sequence[Explanation], limits: RigLimits, period_s: float
) -> list[Part]:
    """Return the part that all programs begin with: the largest strokes that the limits allow."""
    for share in STROKES:
        begin = make_repeated_part(share * limits.command_v, limits.command_v)
        program = make_program([*begin, make_vent(limits.command_v)])
        runs = ProgramTrial(program, explanations, period_s).runs
        if all(map(limits.allows, runs.values())):
            return begin
    return make_repeated_part(0.0, limits.command_v)


def _are_of_muscle(explanations: Sequence[Explanation]) -> bool:
    """Tell whether both blocks were driven, by a valve: then a program can be simulated whole."""
    evidence = explanations[0].model.evidence
    return evidence.nominal.actuator == "muscle" and {*evidence.blocks} == {PRESSURE, MECHANICS}


def _is_admitted(trial: ProgramTrial, limits: RigLimits) -> bool:
    return all(limits.admits(trial.commands_v, r, trial.period_s) for r in trial.runs.values())


def _count_promised(
    trial: ProgramTrial, explanations: Sequence[Explanation], records_s: float
) -> int:
    """Count the pairs of which the wrong one would pass its limit, over all records together."""
    share = trial.duration_s / (trial.duration_s + records_s)
    models = {e.name: e.model for e in explanations}

    def is_promised(s: Separation) -> bool:
        floor = models[s.refuted].floors[s.block]
        pooled = hypot(1.0, np.sqrt(share * (s.residual_over_floor**2 - 1.0)))
        return bool(pooled > CLEAR * floor.limit / floor.mean)

    both: dict[frozenset[str], bool] = {}
    for s in trial.separations:
        key = frozenset({s.true, s.refuted})
        both[key] = both.get(key, True) and is_promised(s)
    return sum(both.values())


def _describe(
    trial: ProgramTrial, drawn: int, inside: int, limits_from: str, *, promises: bool
) -> DecidingProgram:
    runs = trial.runs.values()
    return DecidingProgram(
        trial.program,
        tuple(trial.runs),
        trial.separations,
        max(float(run.pressure_pa.max()) for run in runs),
        min(float(run.position_m.min()) for run in runs),
        max(float(run.position_m.max()) for run in runs),
        trial.duration_s,
        promises,
        drawn,
        inside,
        limits_from,
    )
