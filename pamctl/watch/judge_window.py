"""One window of a run against the model: how far each block is off, and how far noise takes it.

Each block is driven by the other's measured signal, from the measured state. The window begins with
a run-in that is not judged: valve, bristles and the error of the start settle there. The floor is
the model's own: it simulates this very window, its output gets the sensors' noise, and is judged in
the same way. A cumulative sum for each block and activity makes windows an alarm.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.signal import butter, savgol_filter, sosfiltfilt

from pamctl.diagnose.record import Array, Record, estimate_white_noise
from pamctl.plant.drive import drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import PlantParameters, rest_state
from pamctl.plant.sample_grid import build_grid, count_steps

REST, CHOKED, SWING = "rest", "choked flow", "swing"
CONTRACTION, EXTENSION, STROKE = "contraction", "extension", "strokes"
FLOW_V = 0.3
"""RMS of a command that moves air (V)."""
MOVED_NOISES = 20.0
"""A pressure that moves by this multiple of its noise shows the valve."""
CHOKED_SHARE = 0.05
"""Share of a window with choked flow at a large command."""
LARGE_V = 2.0
MOVED_STEPS = 30.0
"""A motion of this many deviations of the encoder's reading shows friction and spring."""
ONE_WAY = 0.9


def find_pressure_activity(
    record: Record, judged: Array, p: PlantParameters, noise_pa: float
) -> tuple[str, bool]:
    """Return what the valve did, and whether that can confirm the pressure block."""
    pressure_pa, valve_v = record["pressure_pa"][judged], record["valve_v"][judged]
    low_pa, high_pa = np.quantile(pressure_pa, [0.02, 0.98])
    moved = high_pa - low_pa > MOVED_NOISES * noise_pa
    if not moved or float(np.sqrt(np.mean(valve_v**2))) < FLOW_V / 10.0:
        return REST, False
    numbers = p.paper
    ratio = np.where(
        valve_v > 0.0,
        pressure_pa / numbers.tank_pressure_pa,
        numbers.atmospheric_pressure_pa / np.maximum(pressure_pa, 1.0),
    )
    choked = (np.abs(valve_v) > LARGE_V) & (ratio < numbers.critical_ratio)
    return (CHOKED if float(np.mean(choked)) > CHOKED_SHARE else SWING), True


def find_mechanics_activity(record: Record, judged: Array, noise_m: float) -> tuple[str, bool]:
    """Return how the muscle moved, and whether that can confirm the mechanics."""
    position_m = record["position_m"][judged]
    span_m = float(np.ptp(position_m))
    if span_m < MOVED_STEPS * noise_m:
        return REST, False
    net_m = float(position_m[-1] - position_m[0])
    if abs(net_m) < ONE_WAY * span_m:
        return STROKE, True
    return (CONTRACTION if net_m > 0.0 else EXTENSION), True


PRESSURE, MECHANICS = "pressure", "mechanics"

RUN_IN_S = 0.5
JUDGED_S = 1.0
START_SAMPLES = 20
"""Samples whose mean is what a window starts from; its error is projected out."""
START_STEP_PA = 500.0
SMOOTH_HZ = 60.0
"""Cutoff for a measured pressure before it drives the mechanics: friction rectifies its noise."""
CUBIC_SAMPLES = 15
"""Of the cubic that smooths a position before it drives the pressure."""
DRAWS = 2
"""Simulations of the floor in each window: each costs as much as the window itself."""
MEAN_S = 0.01
"""A pressure is judged by means over this time: most misfits are slower, the noise is not."""
SMALLEST_SHARE = 0.5
"""A misfit below this share of the floor does not count: no plant file is exact."""
SMALLEST = {PRESSURE: 60.0, MECHANICS: 6.4e-6}
"""A smaller misfit does not count either (Pa, m)."""
LOUDEST = 3.0
"""A noise that grows makes the floor grow, up to this factor."""


@dataclass(frozen=True)
class SensorNoise:
    """White noise of a sensor, and the converter behind it, in the channel's unit."""

    deviation: float
    resolution: float
    """Step of the converter; 0 where none is visible."""

    @property
    def total(self) -> float:
        """Standard deviation with the converter's rounding."""
        return float(np.hypot(self.deviation, self.resolution / np.sqrt(12.0)))

    def simulate_sensor(self, values: Array, random: np.random.Generator) -> Array:
        """Return what the sensor would show: noise is added, then rounded to the nearest step."""
        noisy = values + random.normal(0.0, self.deviation, len(values))
        if self.resolution == 0.0:
            return noisy
        if not noisy.any():  # the rounding error of a signal that moves
            return random.uniform(-0.5, 0.5, len(noisy)) * self.resolution
        # The zero of the converter lies anywhere within a step.
        offset = random.uniform(0.0, self.resolution)
        return np.round((noisy - offset) / self.resolution) * self.resolution + offset


def read_sensor_noise(record: Record, channel: str) -> SensorNoise:
    """Return a channel's noise: as stated, or from its differences."""
    step = record.find_step(channel)
    total = record.stated_noise.get(channel, estimate_white_noise(record[channel]))
    return SensorNoise(float(np.sqrt(max(total**2 - step**2 / 12.0, 0.0))), step)


@dataclass(frozen=True)
class WindowMisfit:
    """What one window says of one block."""

    block: str
    activity: str
    """What the rig did: blocks have other limits at rest than in motion."""
    shows: bool
    """False where the excitation is too small to confirm the model."""
    rms: float
    """Measured against modelled, Pa or m."""
    floor: float
    """The same of the model's own data."""
    excess: float
    """Logarithm of `rms` over the floor with the misfit that does not count; 0 at the floor."""
    spread: float
    """Scatter of that logarithm among the model's own data."""


@dataclass(frozen=True)
class WindowJudge:
    """The model of one rig, and the noise of its sensors by channel."""

    plant: PlantSettings
    noises: Mapping[str, SensorNoise]

    def judge(self, record: Record, seed: int) -> list[WindowMisfit]:
        """Judge the blocks that the record can drive; its first `RUN_IN_S` are the run-in."""
        p = plant_parameters(self.plant)
        random = np.random.default_rng(seed)
        judged = record.t_s - record.t_s[0] >= RUN_IN_S
        found = [self._judge_pressure(p, record, judged, random)]
        if self.plant.actuator == "muscle":
            found.append(self._judge_mechanics(p, record, judged, random))
        return found

    def _judge_pressure(
        self, p: PlantParameters, record: Record, judged: Array, random: np.random.Generator
    ) -> WindowMisfit:
        noise, measured_pa = self.noises["pressure_pa"], record["pressure_pa"]
        cubic = partial(savgol_filter, window_length=CUBIC_SAMPLES, polyorder=3)
        position_m = _smooth(record, record["position_m"], cubic)
        grid = build_grid(
            record.step_s, len(record), count_steps(record.period_s),
            record.acts_after_s, record.held_v,
        )  # fmt: skip

        def simulate(start_pa: float) -> Array:
            start = rest_state(p, float(position_m[0]), start_pa)
            return drive_pressure(p, record["valve_v"], position_m, grid, start=start).pressure_pa

        start_pa = _start_pressure(measured_pa)
        shown = simulate(start_pa)
        mode = (simulate(start_pa + START_STEP_PA) - shown) / START_STEP_PA
        length = max(round(MEAN_S / record.period_s), 1)
        rms = _rms_without(measured_pa - shown, mode, judged, length)
        louder = _find_growth(measured_pa - shown, noise)
        floors = []
        for _ in range(DRAWS):
            drawn = shown + louder * (noise.simulate_sensor(shown, random) - shown)
            error = drawn - simulate(_start_pressure(drawn))
            floors.append(_rms_without(error, mode, judged, length))
        activity = find_pressure_activity(record, judged, p, noise.total)
        return _compare(PRESSURE, *activity, rms, floors)

    def _judge_mechanics(
        self, p: PlantParameters, record: Record, judged: Array, random: np.random.Generator
    ) -> WindowMisfit:
        noise, driving = self.noises["position_m"], self.noises["pressure_pa"]
        grid = build_grid(record.step_s, len(record), count_steps(record.period_s))
        sections = butter(2, SMOOTH_HZ, fs=1.0 / record.period_s, output="sos")
        below = partial(sosfiltfilt, sections, padtype="even")
        pressure_pa = _smooth(record, record["pressure_pa"], below)

        def simulate(driven_pa: Array, measured_m: Array) -> Array:
            start = rest_state(p, float(np.mean(measured_m[:START_SAMPLES])), float(driven_pa[0]))
            return drive_mechanics(p, driven_pa, grid, start=start).position_m

        shown = simulate(pressure_pa, record["position_m"])
        rms = _rms_without(record["position_m"] - shown, None, judged)
        floors = []
        for _ in range(DRAWS):
            disturbance = driving.simulate_sensor(np.zeros(len(record)), random)
            drawn = noise.simulate_sensor(shown, random)
            error = drawn - simulate(pressure_pa + _smooth(record, disturbance, below), drawn)
            floors.append(_rms_without(error, None, judged))
        activity = find_mechanics_activity(record, judged, noise.total)
        return _compare(MECHANICS, *activity, rms, floors)


def _smooth(record: Record, values: Array, smooth: Callable[[Array], Array]) -> Array:
    """Smooth evenly spaced values, over missed ticks too, shape (n,)."""
    even_s = record.t_s[0] + np.arange(0.0, record.duration_s + record.period_s, record.period_s)
    even = smooth(np.interp(even_s, record.t_s, values))
    return np.asarray(np.interp(record.t_s, even_s, even))


def _start_pressure(measured_pa: Array) -> float:
    return float(np.mean(measured_pa[:START_SAMPLES]))


def _find_growth(error: Array, noise: SensorNoise) -> float:
    """Return how much louder than known the sensor is: by third differences, no slow misfit."""
    third = np.diff(error, 3)
    known = np.diff(noise.simulate_sensor(np.zeros(len(error)), np.random.default_rng(0)), 3)
    loud, usual = (float(np.median(np.abs(part))) for part in (third, known))
    return float(np.clip(loud / usual, 1.0, LOUDEST)) if usual > 0.0 else 1.0


def _rms_without(error: Array, mode: Array | None, judged: Array, length: int = 1) -> float:
    """Return the RMS of means over `length` samples, without what an error of the start explains.

    Only `judged` samples count.
    """
    if mode is not None:
        error = error - mode * (mode @ error / (mode @ mode))
    counted = error[judged]
    whole = len(counted) // length * length
    means = counted[:whole].reshape(-1, length).mean(axis=1)
    return float(np.sqrt(np.mean(means**2)))


def _compare(
    block: str, activity: str, shows: bool, rms: float, floors: list[float]
) -> WindowMisfit:
    logs = np.log(np.maximum(floors, 1e-12))
    floor = float(np.exp(logs.mean()))
    allowed = max(SMALLEST_SHARE * floor, SMALLEST[block])
    excess = float(np.log(max(rms, 1e-12) / np.hypot(floor, allowed)))
    return WindowMisfit(block, activity, shows, rms, floor, excess, float(logs.std(ddof=1)))


ALLOWANCE = 0.75
"""A window must be this many deviations over its limit to count."""
ALARM = 6.0
"""Sums of faultless rigs stayed below 2.5: see the manual, watch-a-rig-for-changes."""
MOST_OF_ONE = 6.0
"""No single window raises the alarm, however far off it is."""
LEAST_OF_ONE = -3.0
FULL = 2.0 * ALARM
"""A sum grows no further: an alarm whose cause is mended ends within some windows."""
SMALLEST_SPREAD = {PRESSURE: 0.1, MECHANICS: 0.15}
"""Deviation of a window's logarithm, at least."""
RESTING = 3.0
"""Where too little moves to confirm the model, a window counts this many times less: friction holds
one state for long, and all windows of it are alike."""
REMEMBERED = 30
"""Windows of the same activity whose scatter counts."""


@dataclass(frozen=True)
class MisfitAlarm:
    """A block has left the model."""

    block: str
    activity: str
    since_s: float
    """Start of the first window that counted."""
    over_floor: float
    """Misfit over the floor, both as RMS over the windows since then."""
    rms: float
    """Misfit, Pa or m."""


@dataclass
class _Sum:
    value: float = 0.0
    is_raised: bool = False
    squares: list[tuple[float, float]] = field(default_factory=list)
    since_s: float = 0.0
    spreads: list[float] = field(default_factory=list)

    def take(self, misfit: WindowMisfit, start_s: float) -> None:
        self.spreads = [*self.spreads[1 - REMEMBERED :], misfit.spread]
        scatter = float(np.sqrt(np.mean(np.square(self.spreads))))
        deviations = misfit.excess / max(SMALLEST_SPREAD[misfit.block], scatter)
        if not misfit.shows:
            deviations /= RESTING
        score = float(np.clip(deviations, LEAST_OF_ONE, MOST_OF_ONE)) - ALLOWANCE
        if self.value <= 0.0:
            self.squares, self.since_s = [], start_s
        self.value = float(np.clip(self.value + score, 0.0, FULL))
        self.squares = [*self.squares[1 - REMEMBERED :], (misfit.rms**2, misfit.floor**2)]
        self.is_raised = self.value > ALARM or (self.is_raised and self.value > 0.0)


class MisfitSums:
    """The sums of one rig, which go on from run to run."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, str], _Sum] = defaultdict(_Sum)

    def take(self, misfit: WindowMisfit, start_s: float) -> None:
        """Add a window that began at `start_s`, on any clock that goes on from run to run."""
        self._sums[misfit.block, misfit.activity].take(misfit, start_s)

    def find_alarm(self, block: str) -> MisfitAlarm | None:
        """Return the alarm of a block: since the first of its activities, of the worst one."""
        raised = {a: s for (b, a), s in self._sums.items() if b == block and s.is_raised}
        if not raised:
            return None
        activity, worst = max(raised.items(), key=lambda item: _ratio_of(item[1]))
        rms = float(np.sqrt(np.mean([square for square, _ in worst.squares])))
        since_s = min(s.since_s for s in raised.values())
        return MisfitAlarm(block, activity, since_s, _ratio_of(worst), rms)


def _ratio_of(one: _Sum) -> float:
    squares = np.array(one.squares)
    return float(np.sqrt(squares[:, 0].sum() / max(squares[:, 1].sum(), 1e-30)))
