"""One window of a run against the model: how far each block is off, and how far noise takes it.

Each block is driven by the other's measured signal, from the measured state, as in the diagnosis.
The window begins with a run-in that is not judged: valve, bristles and the error of the start
settle there. The floor is the model's own: it simulates this very window, its output gets the
sensors' noise, and is judged in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.signal import butter, savgol_filter, sosfiltfilt

from pamctl.diagnose.measured.noise.sensor_noise import Noise
from pamctl.diagnose.measured.record import Array, Record
from pamctl.monitor.activity import find_mechanics_activity, find_pressure_activity
from pamctl.plant.drive import build_grid, count_steps, drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import PlantParameters, rest_state

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
    noises: Mapping[str, Noise]

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
        position_m = _smooth(record, record["position_m"], _smooth_by_cubic)
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


def _smooth_by_cubic(values: Array) -> Array:
    return np.asarray(savgol_filter(values, CUBIC_SAMPLES, 3))


def _start_pressure(measured_pa: Array) -> float:
    return float(np.mean(measured_pa[:START_SAMPLES]))


def _find_growth(error: Array, noise: Noise) -> float:
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
