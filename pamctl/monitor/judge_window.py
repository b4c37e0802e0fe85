"""One window of a run against the model: how far each block is off, and how far noise takes it.

Each block is driven by the other's measured signal, from the measured state, as in the diagnosis.
The window begins with a run-in that is not judged: valve, bristles and the error of the start
settle there. The floor is the model's own: it simulates this very window, its output gets the
sensors' noise, and is judged in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pamctl.diagnose.fitting.drives import (
    MECHANICS,
    PRESSURE,
    SMOOTH_HZ,
    Drive,
    has_constant_volume,
    smooth_signal,
)
from pamctl.diagnose.measured.noise.sensor_noise import Noise
from pamctl.diagnose.measured.record import Array, Record
from pamctl.monitor.activity import find_mechanics_activity, find_pressure_activity
from pamctl.plant.drive import count_steps
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import PlantParameters

RUN_IN_S = 0.5
JUDGED_S = 1.0
START_SAMPLES = 20
"""Samples whose mean is the pressure from which a window starts; its error is projected out."""
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
        if not has_constant_volume(self.plant):
            found.append(self._judge_mechanics(p, record, judged, random))
        return found

    def _judge_pressure(
        self, p: PlantParameters, record: Record, judged: Array, random: np.random.Generator
    ) -> WindowMisfit:
        noise = self.noises["pressure_pa"]
        measured_pa = record["pressure_pa"]
        drive = Drive(
            PRESSURE,
            record.name,
            record.step_s,
            record["valve_v"],
            smooth_signal(record["position_m"], record.step_s, 0.0),
            0.0,
            measured_pa,
            max(noise.total, 1.0),
            0.0,
            _start_pressure(measured_pa),
            count_steps(record.period_s),
            acts_after_s=record.acts_after_s,
            held_v=record.held_v,
        )
        mode = self._find_start_mode(p, drive)
        shown = drive.simulate_with(p)
        length = max(round(MEAN_S / record.period_s), 1)
        rms = _rms_without(drive.measured - shown, mode, judged, length)
        louder = _find_growth(measured_pa - shown, noise)
        floors = []
        for _ in range(DRAWS):
            drawn = shown + louder * (noise.simulate_sensor(shown, random) - shown)
            again = replace(drive, measured=drawn, start=_start_pressure(drawn))
            floors.append(_rms_without(drawn - again.simulate_with(p), mode, judged, length))
        activity = find_pressure_activity(record, judged, p, noise.total)
        return _compare(PRESSURE, *activity, rms, floors)

    def _find_start_mode(self, p: PlantParameters, drive: Drive) -> Array:
        """Return how an error of the start goes on, shape (n,)."""
        step_pa = 500.0
        moved = replace(drive, start=drive.start + step_pa)
        mode: Array = (moved.simulate_with(p) - drive.simulate_with(p)) / step_pa
        return mode

    def _judge_mechanics(
        self, p: PlantParameters, record: Record, judged: Array, random: np.random.Generator
    ) -> WindowMisfit:
        noise, driving = self.noises["position_m"], self.noises["pressure_pa"]
        drive = Drive(
            MECHANICS,
            record.name,
            record.step_s,
            np.zeros(len(record)),
            smooth_signal(record["pressure_pa"], record.step_s, SMOOTH_HZ),
            SMOOTH_HZ,
            record["position_m"],
            max(noise.total, 1e-7),
            0.0,
            float(record["position_m"][0]),
            count_steps(record.period_s),
            windows=(slice(0, len(record)),),
            has_known_start=False,
        )
        shown = drive.simulate_with(p)
        rms = _rms_without(drive.measured - shown, None, judged)
        floors = []
        for _ in range(DRAWS):
            disturbance = smooth_signal(
                driving.simulate_sensor(np.zeros(len(record)), random), record.step_s, SMOOTH_HZ
            )
            drawn = noise.simulate_sensor(shown, random)
            again = replace(drive, measured=drawn, driven=drive.driven + disturbance)
            floors.append(_rms_without(drawn - again.simulate_with(p), None, judged))
        activity = find_mechanics_activity(record, judged, noise.total)
        return _compare(MECHANICS, *activity, rms, floors)


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
