"""Choose the program that decides between the explanations that a diagnosis leaves.

chosen = choose_deciding_program(explanations, records)
chosen.separations       what the wrong one of two explanations would leave of its run
chosen.to_experiment()   the keys of the experiment file
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pamctl.control.experiment import ProgramSettings
from pamctl.diagnose.deciding.drawn_programs import (
    Block,
    Part,
    draw_programs,
    make_program,
    make_repeated_part,
    make_vent,
)
from pamctl.diagnose.deciding.explanations import Explanation
from pamctl.diagnose.deciding.rig_limits import RigLimits, find_rig_limits
from pamctl.diagnose.deciding.separation import ProgramTrial, Separation
from pamctl.diagnose.measured.record import Record

PROGRAMS = 100
FINALISTS = 6
"""Programs of each rough order whose separation is computed, with a refit by one step."""
BEST = 6
"""The best of them; their blocks are mixed anew."""
MIXED = 24
MOST_SURE = 5.0
"""A pair that is surer counts no more: the others need the time."""
FORECAST = 3
"""This many programs are forecast, by some steps of the wrong explanations."""
STROKES = (1.0, 0.6, 0.4, 0.2, 0.1)
"""Sizes of the strokes that all programs begin with, as shares of the largest command; the largest
that stays within the limits counts."""

_Tried = tuple[ProgramTrial, tuple[Block, ...]]


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
    drawn: int
    """Programs that were drawn."""
    inside: int
    """Those that stay within the limits."""
    limits_from: str

    @property
    def sureness(self) -> float:
        """The surest refutation; above 1, this program alone should refute an explanation."""
        return max(s.sureness for s in self.separations)

    @property
    def promises(self) -> bool:
        """Some explanation is refuted if another is true."""
        return self.sureness > 1.0

    @property
    def nearest(self) -> Separation:
        """The pair that is separated least, of those with a forecast if there are any."""
        sure = [s for s in self.separations if s.is_forecast] or self.separations
        return min(sure, key=lambda s: s.residual_over_floor)

    @property
    def forecast(self) -> dict[str, Any]:
        """What a later diagnosis judges: pairs whose figure holds, and what the rig is asked for.

        The key `residual_over_floor` holds RMS over the sensor's noise.
        """
        pairs = [
            {
                "true": s.true,
                "refuted": s.refuted,
                "block": s.block,
                "residual_over_floor": float(f"{s.residual_over_floor:.4g}"),
            }
            for s in self.separations
            if s.is_forecast
        ]
        return {
            "pairs": pairs,
            "pressure_kpa": round(1e-3 * self.pressure_pa, 1),
            "low_mm": round(1e3 * self.low_m, 2),
            "high_mm": round(1e3 * self.high_m, 2),
        }

    def to_experiment(self) -> dict[str, Any]:
        """Return the keys of the experiment file, with the forecast in it if there is one."""
        keys = self.program.model_dump(mode="json", exclude_none=True)
        return {**keys, "forecast": self.forecast} if self.forecast["pairs"] else keys


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

    def try_programs(count: int, pool: Sequence[Block] = ()) -> list[_Tried]:
        drawn = draw_programs(count, limits.command_v, begin, seed, pool)
        tried = [(ProgramTrial(d.program, explanations, period_s), d.blocks) for d in drawn]
        return [t for t in tried if all(map(limits.allows, t[0].runs.values()))]

    inside = try_programs(programs)
    best = _keep_best(_select_finalists(inside), BEST)
    pool = [block for _, blocks in best for block in blocks]
    mixed = try_programs(MIXED, pool) if pool else []
    best = _keep_best([*best, *mixed], BEST)
    admitted = [trial for trial, _ in best if _is_admitted(trial, limits)]
    if not admitted:
        return None
    chosen = max(admitted[:FORECAST], key=lambda t: _weigh(t.forecasts))
    return _describe(chosen, programs + MIXED, len(inside) + len(mixed), limits.source)


def _select_finalists(inside: Sequence[_Tried]) -> list[_Tried]:
    """Return the programs that differ most, as a whole or in their fast part."""
    found: dict[int, _Tried] = {}
    for part in (0, 1):
        ranked = sorted(inside, key=lambda t: t[0].rough[part], reverse=True)
        found |= {id(t): t for t in ranked[:FINALISTS]}
    return [*found.values()]


def _keep_best(tried: Sequence[_Tried], count: int) -> list[_Tried]:
    return sorted(tried, key=lambda t: _weigh(t[0].separations), reverse=True)[:count]


def _weigh(separations: Sequence[Separation]) -> tuple[int, float]:
    """Return how many pairs are decided, whichever is true; then how surely the mean one is."""
    pairs: dict[frozenset[str], float] = {}
    for s in separations:
        key = frozenset({s.true, s.refuted})
        pairs[key] = min(s.sureness, pairs.get(key, np.inf))
    sures = pairs.values()
    return sum(sure > 1.0 for sure in sures), sum(min(sure, MOST_SURE) for sure in sures)


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
    """Tell whether a valve drove both blocks: then a program can be simulated whole."""
    e = explanations[0]
    channels = {*e.weigher.train.channels}
    return e.nominal.actuator == "muscle" and channels == {"pressure_pa", "position_m"}


def _is_admitted(trial: ProgramTrial, limits: RigLimits) -> bool:
    return all(limits.admits(trial.commands_v, r, trial.period_s) for r in trial.runs.values())


def _describe(trial: ProgramTrial, drawn: int, inside: int, limits_from: str) -> DecidingProgram:
    runs = trial.runs.values()
    return DecidingProgram(
        trial.program,
        tuple(trial.runs),
        trial.forecasts,
        max(float(run.pressure_pa.max()) for run in runs),
        min(float(run.position_m.min()) for run in runs),
        max(float(run.position_m.max()) for run in runs),
        trial.duration_s,
        drawn,
        inside,
        limits_from,
    )
