"""By how much a program separates explanations: what the wrong one would leave of its run.

One explanation is simulated as if it were true, and the other is fitted to what the sensors would
show. The fit may move all its numbers, at the price of what they explain of the records so far:
Gauss-Newton steps on both together, by the tangents. What is left is weighed by the likelihood of
the records: the same Haar levels and scales, never finer than the poorer model can resolve.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, permutations

import numpy as np
from scipy.ndimage import uniform_filter1d

from pamctl.control.experiment import ProgramSettings
from pamctl.diagnose.deciding.drawn_programs import sample_commands
from pamctl.diagnose.deciding.explanations import Explanation
from pamctl.diagnose.deciding.rig_limits import ProgramRun
from pamctl.diagnose.evidence.constants import COARSE_STEP_S, NAME_NATS, NU, NUGGET
from pamctl.diagnose.evidence.fit import STEP, WeighedModel, Weigher, bound_gain
from pamctl.diagnose.evidence.likelihood import to_haar
from pamctl.diagnose.evidence.run_pieces import Runs, join_waves
from pamctl.diagnose.measured.record import Array, Record

BLOCKS = {"pressure_pa": "pressure", "position_m": "mechanics"}
"""What a forecast calls the channels."""
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
    """One program, simulated under every explanation."""

    def __init__(
        self, program: ProgramSettings, explanations: Sequence[Explanation], period_s: float
    ) -> None:
        """Simulate the coupled plant of each explanation."""
        self.program, self.explanations, self.period_s = program, tuple(explanations), period_s
        self.commands_v = sample_commands(program, period_s)
        weigher = explanations[0].weigher
        # The vent at the end goes on to the end of a block.
        missing = -len(self.commands_v) % weigher.train.block
        whole_v = np.pad(self.commands_v, (0, missing), mode="edge")
        self._runs = _make_runs(whole_v, period_s, weigher)
        self._keep = self._runs.find_kept(weigher.like.level)
        self._shown: dict[str, Array] = {}
        self.runs: dict[str, ProgramRun] = {}
        for e in explanations:
            plain, _ = join_waves(e.values)
            self.runs[e.name] = self._cut(self._runs.simulate(plain, COARSE_STEP_S))
            self._shown[e.name] = self._runs.simulate(e.values, COARSE_STEP_S)
        self._tangents: dict[str, Array] = {}

    @property
    def duration_s(self) -> float:
        """The length of the program."""
        return len(self.commands_v) * self.period_s

    def _cut(self, rows: Array) -> ProgramRun:
        flat = rows.reshape(len(rows), -1)[:, : len(self.commands_v)]
        by_channel = dict(zip(self._runs.channels, flat, strict=True))
        return ProgramRun(**by_channel)

    @cached_property
    def rough(self) -> tuple[float, float]:
        """The least difference of two explanations' signals over the noise, with nothing refitted.

        First all of it, then its fast part: a refit takes the slow part away first. They cost one
        simulation an explanation, and sort the programs before the dearer figure.
        """
        pairs = [self._compare_roughly(a, b) for a, b in combinations(self.explanations, 2)]
        return min(whole for whole, _ in pairs), min(fast for _, fast in pairs)

    def _compare_roughly(self, a: Explanation, b: Explanation) -> tuple[float, float]:
        noise = np.sqrt(a.weigher.find_noise2(a.model))[:, None]
        off = self._shown[a.name] - self._shown[b.name]
        off = off.reshape(len(off), -1) / noise
        fast = off - uniform_filter1d(off, max(1, round(SLOW_S / self.period_s)), axis=1)
        return float(_rms(off).max()), float(_rms(fast).max())

    @cached_property
    def separations(self) -> tuple[Separation, ...]:
        """Every explanation against every other that were true; refitted by one straight step."""
        return self._separate_all(self._step_once)

    @cached_property
    def forecasts(self) -> tuple[Separation, ...]:
        """The same, by some steps that are simulated: right also where the numbers go far."""
        return self._separate_all(self._step_on)

    def _separate_all(
        self, refit: Callable[[Explanation, Explanation], tuple[Array, bool]]
    ) -> tuple[Separation, ...]:
        return tuple(
            self._separate(true, other, *refit(true, other))
            for true, other in permutations(self.explanations, 2)
        )

    def _separate(
        self, true: Explanation, other: Explanation, left: Array, agrees: bool
    ) -> Separation:
        weigher = true.weigher
        squares = (left**2 * self._keep).sum(axis=(1, 2)) / self._keep.sum(axis=(1, 2))
        noise2 = weigher.find_noise2(true.model)
        block = int((squares / noise2).argmax())
        here2 = weigher.like.mean_squares(true.model.d)[block]
        over = float(np.sqrt((squares[block] + here2) / noise2[block]))
        nats = self._count_nats(true.model, left, squares)
        sure = self._find_sureness(true.model, other.model, nats)
        name = BLOCKS[self._runs.channels[block]]
        # A curve's knots follow the reach of the records: with this run it would be another.
        agrees &= not any(v.is_curve for v in other.model.picked.values())
        return Separation(true.name, other.name, name, over, sure, agrees)

    def _count_nats(self, true: WeighedModel, left: Array, squares: Array) -> Array:
        """Return what the wrong one loses in each block, beside noise of the right one's scales."""
        level = self.explanations[0].weigher.like.level
        floor2 = NUGGET**2 * squares[:, None]
        scales2 = np.maximum(true.cost.scales2, floor2)[:, level][:, None, :]
        beside = true.cost.scales2[:, level][:, None, :] / scales2
        logs = np.log1p(left**2 / scales2 / (NU + beside))
        return np.asarray(0.5 * (NU + 1.0) * (logs * self._keep).sum(axis=(0, 2)))

    def _find_sureness(self, true: WeighedModel, wrong: WeighedModel, nats: Array) -> float:
        """Return how surely the wrong one would be refuted, by this run and the records so far."""
        gain = np.concatenate([wrong.left_out - true.left_out, nats])
        return float(bound_gain(gain)[0]) / NAME_NATS

    # --- the refit of the wrong one ---

    def _step_once(self, true: Explanation, other: Explanation) -> tuple[Array, bool]:
        change = to_haar(self._shown[true.name] - self._shown[other.name])
        way = self._find_step(true, other, change, np.zeros(len(other.model.x)))
        flat = change.ravel() + way @ self._find_tangent(other)
        return flat.reshape(change.shape), True

    def _step_on(self, true: Explanation, other: Explanation) -> tuple[Array, bool]:
        """Return what is left after some steps, each simulated; and whether the last held."""
        m = other.model
        change, moved = (
            to_haar(self._shown[true.name] - self._shown[other.name]),
            np.zeros(len(m.x)),
        )
        agrees = True
        for _ in range(STEPS):
            way = self._find_step(true, other, change, moved)
            straight = change.ravel() + way @ self._find_tangent(other)
            d = to_haar(self._shown[true.name] - self._simulate(other, moved + way))
            promised, found = float(_rms(straight[None])[0]), float(_rms(d.reshape(1, -1))[0])
            agrees = found <= AGREES * promised
            if found >= float(_rms(change.reshape(1, -1))[0]):
                break
            change, moved = d, moved + way
        return change, agrees

    def _find_step(
        self, true: Explanation, other: Explanation, change: Array, moved: Array
    ) -> Array:
        """Return a Gauss-Newton step, in scales, on the records so far and the program's run."""
        m, weigher = other.model, other.weigher
        assert m.tangent is not None
        old = m.tangent.reshape(len(m.x), -1)
        known = (old * m.cost.weights.ravel()) @ old.T
        squares = (change**2 * self._keep).sum(axis=(1, 2)) / self._keep.sum(axis=(1, 2))
        scales2 = np.maximum(true.model.cost.scales2, NUGGET**2 * squares[:, None])
        scales2 = scales2[:, weigher.like.level][:, None, :]
        weights = ((NU + 1.0) / (NU * scales2 + change**2) * self._keep).ravel()
        slope = self._find_tangent(other)
        both = known + (slope * weights) @ slope.T
        both += RIDGE * np.diag(np.diag(both))
        pull = (slope * weights) @ change.ravel() + known @ moved
        way = -np.linalg.pinv(both, hermitian=True) @ pull
        low, high, scale = (
            np.array([getattr(n, k) for n in m.numbers]) for k in ("low", "high", "scale")
        )
        at = m.x + moved * scale
        return np.asarray(np.clip(way, (low - at) / scale, (high - at) / scale))

    def _find_tangent(self, other: Explanation) -> Array:
        """Return the change of an explanation's own residual for a scale of each number."""
        if other.name not in self._tangents:
            here, rows = self._shown[other.name], []
            for i in range(len(other.model.x)):
                way = np.zeros(len(other.model.x))
                way[i] = STEP
                rows.append(to_haar(here - self._simulate(other, way)).ravel() / STEP)
            self._tangents[other.name] = np.stack(rows)
        return self._tangents[other.name]

    def _simulate(self, e: Explanation, moved: Array) -> Array:
        m = e.model
        x = {n.name: float(v + w * n.scale) for n, v, w in zip(m.numbers, m.x, moved, strict=True)}
        return self._runs.simulate({**e.values, **x}, COARSE_STEP_S)


def _make_runs(commands_v: Array, period_s: float, weigher: Weigher) -> Runs:
    """Return an empty run of these commands, from the vented rest."""
    still, vented = np.zeros(len(commands_v)), weigher.base["atmospheric_pressure_pa"]
    record = Record(
        "program",
        period_s * np.arange(len(commands_v), dtype=np.float64),
        valve_v=commands_v,
        pressure_pa=still + vented,
        position_m=still,
    )
    return Runs([record], weigher.base, weigher.train)


def _rms(rows: Array) -> Array:
    return np.asarray(np.sqrt((rows**2).mean(axis=1)))
