"""Choose the program that decides between the explanations that a diagnosis leaves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, permutations
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from pamctl.control.experiment import ProgramSettings
from pamctl.diagnose.drawn_programs import (
    Block,
    Part,
    ProgramRun,
    RigLimits,
    draw_programs,
    find_rig_limits,
    make_program,
    make_repeated_part,
    make_vent,
    sample_commands,
)
from pamctl.diagnose.evidence.constants import COARSE_STEP_S, NAME_NATS, NU, NUGGET
from pamctl.diagnose.evidence.fit import STEP, WeighedModel, bound_gain
from pamctl.diagnose.evidence.likelihood import to_haar
from pamctl.diagnose.evidence.run_pieces import Runs, join_waves
from pamctl.diagnose.explanations import BLOCKS, Explanation
from pamctl.diagnose.record import Array, Record

STEPS = 3
"""Gauss-Newton steps of a forecast: its end moves what is left by some per cent."""
AGREES = 2.0
"""A last step that promised so many times less than it left makes no forecast."""
RIDGE = 1e-6
SLOW_S = 0.1
"""Differences that last longer are what a refit of gains and rates takes away."""


@dataclass(frozen=True)
class Separation:
    """What one explanation leaves of a run where another is true."""

    true: str
    refuted: str
    block: str
    """The block that shows it best."""
    residual_over_floor: float
    """RMS over the sensor's noise that the wrong one leaves; about 1 where nothing is separated."""
    sureness: float
    """Above 1, the wrong one loses surely more nats than a name must gain, on all records."""
    is_forecast: bool = True
    """False where the figure may be off by more than a factor of 2: the refit goes far, or what
    is refitted is a curve."""


class ProgramTrial:
    """One program under every explanation; each is simulated when it is first asked for."""

    def __init__(
        self, program: ProgramSettings, explanations: Sequence[Explanation], period_s: float
    ) -> None:
        """Sample the commands."""
        self.program, self.explanations, self.period_s = program, tuple(explanations), period_s
        self.commands_v = sample_commands(program, period_s)
        weigher = explanations[0].weigher
        # The vent at the end goes on to the end of a block.
        missing = -len(self.commands_v) % weigher.train.block
        whole_v = np.pad(self.commands_v, (0, missing), mode="edge")
        still, vented = np.zeros(len(whole_v)), weigher.base["atmospheric_pressure_pa"]
        t_s = period_s * np.arange(len(whole_v), dtype=np.float64)
        record = Record("program", t_s, whole_v, pressure_pa=still + vented, position_m=still)
        self._runs = Runs([record], weigher.base, weigher.train)
        self._keep = self._runs.find_kept(weigher.like.level)
        self._simulated: dict[str, tuple[ProgramRun, Array]] = {}
        self._columns: dict[tuple[str, str], Array] = {}

    def run(self, e: Explanation) -> ProgramRun:
        """Return what the coupled plant of an explanation does."""
        return self._simulate_once(e)[0]

    def _show(self, e: Explanation) -> Array:
        """Return what the sensors show of it."""
        return self._simulate_once(e)[1]

    def _simulate_once(self, e: Explanation) -> tuple[ProgramRun, Array]:
        if e.name not in self._simulated:
            plain, _ = join_waves(e.values)
            rows = self._runs.simulate(plain, COARSE_STEP_S).reshape(len(self._runs.channels), -1)
            by_channel = zip(self._runs.channels, rows[:, : len(self.commands_v)], strict=True)
            run = ProgramRun(**dict(by_channel))
            self._simulated[e.name] = run, self._runs.simulate(e.values, COARSE_STEP_S)
        return self._simulated[e.name]

    def stays_within(self, limits: RigLimits) -> bool:
        """Tell whether no explanation exceeds the limits; the first that does ends it."""
        return all(limits.allows(self.run(e)) for e in self.explanations)

    @cached_property
    def rough(self) -> tuple[float, float]:
        """The least difference of two explanations' signals over the noise, with nothing refitted.

        First all of it, then its fast part: a refit takes the slow part away first. They cost one
        simulation an explanation, and sort the programs before the dearer figure.
        """
        whole: list[float] = []
        fast: list[float] = []
        for a, b in combinations(self.explanations, 2):
            noise = np.sqrt(a.noise2)[:, None]
            off = (self._show(a) - self._show(b)).reshape(len(noise), -1) / noise
            slow = uniform_filter1d(off, max(1, round(SLOW_S / self.period_s)), axis=1)
            for found, rows in ((whole, off), (fast, off - slow)):
                found.append(float(np.sqrt((rows**2).mean(axis=1)).max()))
        return min(whole), min(fast)

    @cached_property
    def separations(self) -> tuple[Separation, ...]:
        """Every explanation against every other that were true; refitted by one straight step."""
        return tuple(self._separate(*pair, steps=0) for pair in permutations(self.explanations, 2))

    @cached_property
    def forecasts(self) -> tuple[Separation, ...]:
        """The same, by some steps that are simulated: right also where the numbers go far."""
        return tuple(
            self._separate(*pair, steps=STEPS) for pair in permutations(self.explanations, 2)
        )

    def _separate(self, true: Explanation, other: Explanation, steps: int) -> Separation:
        left, agrees = self._refit(true, other, steps)
        weigher = true.weigher
        squares = self._mean_squares(left)
        channel = int((squares / true.noise2).argmax())
        over = float(np.sqrt((squares[channel] + true.left2[channel]) / true.noise2[channel]))
        # What the wrong one loses in each block, beside noise of the right one's scales; and on
        # the records so far. It is refuted if it surely loses what a name must gain.
        scales2 = self._find_scales2(true.model, squares)
        beside = true.model.cost.scales2[:, weigher.like.level][:, None, :] / scales2
        logs = np.log1p(left**2 / scales2 / (NU + beside))
        nats = 0.5 * (NU + 1.0) * (logs * self._keep).sum(axis=(0, 2))
        gain = np.concatenate([other.model.left_out - true.model.left_out, nats])
        # A curve's knots follow the reach of the records: with this run it would be another.
        agrees &= not any(v.is_curve for v in other.model.picked.values())
        name = BLOCKS[self._runs.channels[channel]]
        sure = float(bound_gain(gain)[0]) / NAME_NATS
        return Separation(true.name, other.name, name, over, sure, agrees)

    def _mean_squares(self, d: Array) -> Array:
        return np.asarray((d**2 * self._keep).sum(axis=(1, 2)) / self._keep.sum(axis=(1, 2)))

    def _find_scales2(self, true: WeighedModel, squares: Array) -> Array:
        """Return the squared scale of each coefficient, never finer than can be resolved."""
        scales2 = np.maximum(true.cost.scales2, NUGGET**2 * squares[:, None])
        return scales2[:, self.explanations[0].weigher.like.level][:, None, :]

    # --- the refit of the wrong one ---

    def _refit(self, true: Explanation, other: Explanation, steps: int) -> tuple[Array, bool]:
        """Return what is left after some steps, each simulated; and whether the last held.

        Of no steps: after a straight one, by the tangents.
        """
        m, agrees = other.model, True
        change = to_haar(self._show(true) - self._show(other))
        slope = self._find_tangent(other, is_own=steps > 0)
        moved = np.zeros(len(m.x))
        for _ in range(max(steps, 1)):
            way = self._find_step(true, other, slope, change, moved)
            straight = change + (way @ slope).reshape(change.shape)
            if not steps:
                return straight, True
            d = to_haar(self._show(true) - self._simulate(other, moved + way))
            promised, found, before = (float(np.mean(x**2)) for x in (straight, d, change))
            agrees = found <= AGREES**2 * promised
            if found >= before:
                break
            change, moved = d, moved + way
        return change, agrees

    def _find_step(
        self, true: Explanation, other: Explanation, slope: Array, change: Array, moved: Array
    ) -> Array:
        """Return a Gauss-Newton step, in scales, on the records so far and the program's run."""
        m = other.model
        scales2 = self._find_scales2(true.model, self._mean_squares(change))
        weights = ((NU + 1.0) / (NU * scales2 + change**2) * self._keep).ravel()
        weighed = slope * weights
        both = other.known + weighed @ slope.T
        both += RIDGE * np.diag(np.diag(both))
        pull = weighed @ change.ravel() + other.known @ moved
        way = -np.linalg.pinv(both, hermitian=True) @ pull
        low, high, scale = (
            np.array([getattr(n, k) for n in m.numbers]) for k in ("low", "high", "scale")
        )
        at = m.x + moved * scale
        return np.asarray(np.clip(way, (low - at) / scale, (high - at) / scale))

    def _find_tangent(self, other: Explanation, *, is_own: bool) -> Array:
        """Return the change of an explanation's own residual for a scale of each number.

        Not its own: a number moves what it moves under the first explanation with the same law.
        """
        columns = []
        for number in other.laws.items():
            alike = (e for e in self.explanations if number in e.laws.items())
            columns.append(self._find_column(other if is_own else next(alike), number[0]))
        return np.stack(columns)

    def _find_column(self, e: Explanation, name: str) -> Array:
        if (e.name, name) not in self._columns:
            way = np.array([STEP * (n == name) for n in e.laws])
            moves = self._show(e) - self._simulate(e, way)
            self._columns[e.name, name] = to_haar(moves).ravel() / STEP
        return self._columns[e.name, name]

    def _simulate(self, e: Explanation, moved: Array) -> Array:
        m = e.model
        x = {n.name: float(v + w * n.scale) for n, v, w in zip(m.numbers, m.x, moved, strict=True)}
        return self._runs.simulate({**e.values, **x}, COARSE_STEP_S)


PROGRAMS = 100
"""That are drawn anew."""
FINALISTS = 6
"""Programs of each rough order whose separation is computed, with a refit by one step."""
BEST = 6
"""The best of them; their blocks are mixed anew."""
MIXED = 24
"""Programs of mixed blocks."""
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
    if len(explanations) < 2:
        return None
    first = explanations[0]
    driven = {*first.weigher.train.channels} == {"pressure_pa", "position_m"}
    if first.nominal.actuator != "muscle" or not driven:  # no program can be simulated whole
        return None
    limits = find_rig_limits(records)
    period_s = float(np.median(records[0].step_s))
    begin = choose_repeated_part(explanations, limits, period_s)

    def try_programs(count: int, pool: Sequence[Block] = ()) -> list[_Tried]:
        drawn = draw_programs(count, limits.command_v, begin, seed, pool)
        tried = [(ProgramTrial(d.program, explanations, period_s), d.blocks) for d in drawn]
        return [t for t in tried if t[0].stays_within(limits)]

    inside = try_programs(programs)
    best = _keep_best(inside)
    pool = [block for _, blocks in best for block in blocks]
    mixed = try_programs(MIXED, pool) if pool else []
    admitted = [
        trial
        for trial, _ in _rank([*best, *_keep_best(mixed)])[:BEST]
        if all(limits.admits(trial.commands_v, trial.run(e), period_s) for e in explanations)
    ]
    if not admitted:
        return None
    chosen = max(admitted[:FORECAST], key=lambda t: _weigh(t.forecasts))
    runs = [*map(chosen.run, explanations)]
    return DecidingProgram(
        chosen.program,
        tuple(e.name for e in explanations),
        chosen.forecasts,
        max(float(run.pressure_pa.max()) for run in runs),
        min(float(run.position_m.min()) for run in runs),
        max(float(run.position_m.max()) for run in runs),
        len(chosen.commands_v) * period_s,
        programs + MIXED,
        len(inside) + len(mixed),
        limits.source,
    )


def _keep_best(tried: Iterable[_Tried]) -> list[_Tried]:
    """Return the best of those that differ most, as a whole or in their fast part."""
    finalists: dict[int, _Tried] = {}
    for part in (0, 1):
        ranked = sorted(tried, key=lambda t: t[0].rough[part], reverse=True)
        finalists |= {id(t): t for t in ranked[:FINALISTS]}
    return _rank(finalists.values())[:BEST]


def _rank(tried: Iterable[_Tried]) -> list[_Tried]:
    return sorted(tried, key=lambda t: _weigh(t[0].separations), reverse=True)


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
        if ProgramTrial(program, explanations, period_s).stays_within(limits):
            return begin
    return make_repeated_part(0.0, limits.command_v)
