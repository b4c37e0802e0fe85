"""How a block is judged: by a free run, in windows, or by the residual of its equation.

A block that forgets its start runs freely from it: every error shows, also a slow one. A block
that adds up what drives it (a mass without a spring, a sealed chamber) is judged in windows. Where
inertia does not show in the force, a stiff drive imposes the motion, and the force is the answer.
What the record itself says decides, not the guesses of a plant file.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import inf
from typing import NamedTuple

import numpy as np

from pamctl.diagnose.judging.segments import (
    count_samples,
    differentiate,
    filter_segments,
    find_segments,
    slope_gain,
)
from pamctl.diagnose.judging.windows import build_start_modes, cut_windows
from pamctl.diagnose.measured.noise.sensor_noise import Noise
from pamctl.diagnose.measured.record import REST_V, Array, Record


class JudgeKind(StrEnum):
    """What of a block is compared with the measurement."""

    FREE_RUN = "free_run"
    WINDOWS = "windows"
    EQUATION = "equation"


@dataclass(frozen=True)
class Judge:
    """How a block is judged, and why."""

    kind: JudgeKind
    why: str
    horizon_s: float | None = None
    """Length of the windows; None for a free run, and for the equation, which looks at instants."""
    forgets_start: bool = True
    velocity_time_s: float = inf
    """Time in which the mechanics forget a velocity (mass over damping)."""
    slope_s: float = 0.0
    """Length of the parabolas that differentiate the motion, for the equation."""

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        return {"kind": self.kind.value, "horizon_s": self.horizon_s, "why": self.why}


FREE_RUN = Judge(JudgeKind.FREE_RUN, "the block forgets its start")

FORGETS_SHARE = 0.1
"""A block forgets its start if the slowest of its motions dies within this share of a stretch."""
SPRING_SHARE = 0.2
"""A spring restrains if its force over the travel is at least this share of the force's span. A
softer one lets a small force move the mass through all its travel."""
INERTIA_SHOWS = 2.0
"""The mean square without the mass, over that with it, from which the mass counts."""
MOST_WINDOWS_SHARE = 0.1
"""A window is no longer than this share of a record: some must be left to choose and judge by."""
SHORTEST_HORIZON = 20
"""In samples."""
SLOPE_PERIODS = (5, 7, 9, 13, 17, 25, 35, 51)
SLOPE_NOISE = 0.05
"""The noise of a speed, over the usual speed, that the parabolas may leave."""


def judge_chamber(records: Sequence[Record]) -> Judge:
    """Choose the judge of the pressure block: only a chamber that stays sealed never forgets."""
    if any(r.valve_v is not None and np.max(np.abs(r.valve_v)) > REST_V for r in records):
        return _explain_gaps(FREE_RUN, records)
    horizon_s = MOST_WINDOWS_SHARE * min(r.duration_s for r in records)
    why = "the chamber is sealed, and keeps every error of its first pressure"
    return Judge(JudgeKind.WINDOWS, why, horizon_s, forgets_start=False)


def judge_muscle(records: Sequence[Record]) -> Judge:
    """Choose the judge of a muscle's mechanics: its spring makes it forget."""
    return _explain_gaps(FREE_RUN, records)


def judge_mechanism(records: Sequence[Record], noises: dict[str, Noise]) -> Judge:
    """Choose the judge of a mechanism whose position is measured, and its force or pressure."""
    position = noises["position_m"]
    balance = regress_balance(records, choose_slope_s(records, position, 2))
    longest_s = max(
        float(np.sum(r.step_s[part.start : part.stop - 1]))
        for r in records
        for part in find_segments(r.step_s)
    )
    if balance.spring_share >= SPRING_SHARE and balance.memory_s <= FORGETS_SHARE * longest_s:
        return _explain_gaps(FREE_RUN, records)
    if balance.inertia < INERTIA_SHOWS and "force_n" in noises:
        why = (
            "inertia does not show in the force: the motion is imposed, and the force that it "
            "needs is compared"
        )
        return Judge(JudgeKind.EQUATION, why, slope_s=choose_slope_s(records, position))
    horizon_s, limit = _choose_horizon_s(records, noises, balance)
    why = f"no spring brings the mass back, and a free run drifts; {limit}"
    return Judge(
        JudgeKind.WINDOWS,
        why,
        horizon_s,
        forgets_start=False,
        velocity_time_s=balance.velocity_time_s,
    )


def _explain_gaps(judge: Judge, records: Sequence[Record]) -> Judge:
    """Return the judge; where records have gaps, each stretch is a window of its own."""
    parts = [(r, part) for r in records for part in find_segments(r.step_s)]
    if len(parts) == len(records):
        return judge
    longest_s = max(float(np.sum(r.step_s[p.start : p.stop - 1])) for r, p in parts)
    why = f"{judge.why}; a gap begins a new window, from the measured state"
    return Judge(JudgeKind.WINDOWS, why, longest_s)


class Balance(NamedTuple):
    """What a straight least squares finds in the force of a mechanism."""

    mass_kg: float
    damping_n_s_per_m: float
    stiffness_n_per_m: float
    inertia: float
    """Mean square of what is left without the mass, over that with it."""
    spring_share: float
    """Span of the spring's force over that of the force."""

    @property
    def velocity_time_s(self) -> float:
        """Time in which friction stops the mass; infinite without damping."""
        if self.mass_kg <= 0.0:
            return 0.0
        return self.mass_kg / self.damping_n_s_per_m if self.damping_n_s_per_m > 0.0 else inf

    @property
    def memory_s(self) -> float:
        """Time constant of the slowest motion; infinite without a spring."""
        if self.stiffness_n_per_m <= 0.0:
            return inf
        mass, damping = max(self.mass_kg, 0.0), max(self.damping_n_s_per_m, 0.0)
        roots = np.roots([mass, damping, self.stiffness_n_per_m])
        slowest = min((-float(root.real) for root in roots), default=0.0)
        return 1.0 / slowest if slowest > 0.0 else inf


def regress_balance(records: Sequence[Record], slope_s: float) -> Balance:
    """Fit the force by acceleration, speed, direction, position and, where measured, pressure.

    Without a force, the pressure on the piston stands for it: all ratios are then the same.
    """
    columns, forces = [], []
    for record in records:
        motion = [record["position_m"], *_differentiate(record, slope_s)]
        margin = count_samples(slope_s, record.period_s) // 2
        for part in find_segments(record.step_s):
            inner = slice(part.start + margin, part.stop - margin)
            if inner.stop - inner.start < 2:
                continue
            position_m, rate, acceleration = (signal[inner] for signal in motion)
            terms = [acceleration, rate, position_m, np.sign(rate)]
            if record.force_n is not None and record.pressure_pa is not None:
                pressure = record["pressure_pa"][inner]
                terms += [pressure, pressure * np.sign(rate)]
            columns.append(np.column_stack([*terms, np.ones(len(rate))]))
            forces.append(record[_find_drive(record.channels)][inner])
    if not columns:
        return Balance(0.0, 0.0, 0.0, 0.0, 0.0)
    table, force = np.concatenate(columns), np.concatenate(forces)
    table_scale = np.sqrt(np.mean(table**2, axis=0))
    scaled = table / np.where(table_scale > 0.0, table_scale, 1.0)
    full, left = _regress(scaled, force)
    _, left_without = _regress(scaled[:, 1:], force)
    amounts = full / np.where(table_scale > 0.0, table_scale, 1.0)
    shows = left_without / max(left, 1e-12 * float(np.mean(force**2)), 1e-300)
    if amounts[0] < 0.0 and shows >= INERTIA_SHOWS:
        amounts = -amounts  # no mass is negative: a column has the wrong sign, which is said later
    mass, damping, stiffness = (float(amount) for amount in amounts[:3])
    spring = stiffness * float(np.ptp(table[:, 2])) / max(float(np.ptp(force)), 1e-300)
    return Balance(mass, damping, stiffness, shows if mass > 0.0 else 0.0, spring)


def _differentiate(record: Record, length_s: float) -> list[Array]:
    """Return the velocity and the acceleration of a record."""

    def derive(order: int) -> Array:
        return filter_segments(
            record["position_m"],
            record.step_s,
            lambda even: differentiate(even, record.period_s, length_s, order),
            short=0.0,
        )

    return [derive(1), derive(2)]


def _find_drive(channels: Collection[str]) -> str:
    return "force_n" if "force_n" in channels else "pressure_pa"


def _regress(table: Array, force: Array) -> tuple[Array, float]:
    amounts = np.asarray(np.linalg.lstsq(table, force, rcond=None)[0], dtype=np.float64)
    return amounts, float(np.mean((force - table @ amounts) ** 2))


def choose_slope_s(records: Sequence[Record], noise: Noise, order: int = 1) -> float:
    """Return the shortest parabolas that leave little noise in the speed, or the acceleration.

    Where no acceleration stands out of its noise, those of the speed are returned.
    """
    period_s = float(np.median([r.period_s for r in records]))
    lengths_s = [n * period_s for n in SLOPE_PERIODS]
    for length_s in lengths_s:
        noisy = noise.total * slope_gain(length_s, period_s, order)
        shown = np.concatenate([_differentiate(r, length_s)[order - 1] for r in records])
        true_square = float(np.mean(shown**2)) - noisy**2
        if noisy**2 <= SLOPE_NOISE**2 * true_square:
            return length_s
    return lengths_s[-1] if order == 1 else choose_slope_s(records, noise)


def _choose_horizon_s(
    records: Sequence[Record], noises: dict[str, Noise], balance: Balance
) -> tuple[float, str]:
    """Return the longest window over which the force's noise moves less than the sensor's noise.

    Beyond, a longer window shows no more of an effect, and less of it against slow disturbances.
    Also returns the reason in words.
    """
    period_s = float(np.median([r.period_s for r in records]))
    longest_s = MOST_WINDOWS_SHARE * min(r.duration_s for r in records)
    shortest_s = SHORTEST_HORIZON * period_s
    drift_m = _simulate_drift_m(
        noises[_find_drive(noises)], balance, period_s, round(longest_s / period_s)
    )
    times_s: Array = period_s * np.arange(len(drift_m), dtype=np.float64)
    sensor_m = noises["position_m"].total
    horizon_s = shortest_s
    while horizon_s <= longest_s:
        windows = cut_windows([slice(0, len(drift_m))], round(horizon_s / period_s))
        modes = build_start_modes(times_s, windows, balance.velocity_time_s)
        if float(np.sqrt(np.mean(modes.project_out(drift_m) ** 2))) > sensor_m:
            return max(horizon_s / STRIDE, shortest_s), (
                "over longer windows the noise of the force moves the mass by more than the "
                "noise of the position"
            )
        horizon_s *= STRIDE
    return max(longest_s, shortest_s), "longer windows would leave fewer than ten in a record"


STRIDE = 1.25
"""Ratio of the horizons that are tried."""
DRAWN_WINDOWS = 10


def _simulate_drift_m(noise: Noise, balance: Balance, period_s: float, samples: int) -> Array:
    """Return how the noise of the force moves a mass with damping, shape (n,)."""
    force_n = noise.simulate_sensor(
        np.zeros(DRAWN_WINDOWS * max(samples, 2 * SHORTEST_HORIZON)), np.random.default_rng(11)
    )
    time_s = balance.velocity_time_s
    lost = -float(np.expm1(-period_s / time_s)) if time_s else 1.0  # of a velocity in a period
    if np.isfinite(time_s):  # without a mass too; the sign of a column does not matter
        gain = lost / max(abs(balance.damping_n_s_per_m), 1e-300)
    else:
        gain = period_s / balance.mass_kg
    from scipy.signal import lfilter  # most of a second to import, and few records need it

    velocity: Array = lfilter([gain], [1.0, lost - 1.0], force_n - force_n.mean())
    drift: Array = np.cumsum(velocity) * period_s
    return drift
