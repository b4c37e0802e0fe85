"""The two blocks, each driven by the other's measured signal, in output-error form.

    pressure block:  u, measured x -> P          mechanics block:  measured P -> x

A block without a fault then stays at its noise floor, whatever the other block hides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, savgol_filter, sosfiltfilt

from pamctl.diagnose.measured.record import Array, Record
from pamctl.diagnose.measured.sensor_noise import Noise
from pamctl.plant.drive import (
    STEPS_A_TICK,
    SampleGrid,
    build_grid,
    drive_coupled,
    drive_mechanics,
    drive_pressure,
)
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import PlantParameters, rest_state

PRESSURE, MECHANICS = "pressure", "mechanics"

SMOOTH_HZ = 60.0
"""Cutoff for a measured pressure before it drives the mechanics: friction rectifies its noise."""
MODELLED_HZ = 1.0
"""Cutoff for measured minus modelled pressure where the pressure block is at its floor."""
VENTED_PA = 20e3
"""Tolerance of a sensor's zero; a muscle that starts higher does not start vented."""
SETTLED_MS = 1000
"""Time after which a muscle stands still (ms)."""
RUNAWAY = 1e6
"""Residual of a model that runs away, in deviations of the sensor. A spring with a negative rate
does so."""


@dataclass(frozen=True)
class Drive:
    """One record for one block: the inputs, and the measured output."""

    block: str
    name: str
    step_s: Array
    """Time from each sample to the next, shape (n - 1,)."""
    valve_v: Array
    """Command after each sample, shape (n,); zeros for the mechanics."""
    driven: Array
    """Position (pressure block) or pressure (mechanics), smoothed, shape (n,)."""
    cutoff_hz: float
    """Cutoff of the filter on `driven`; 0 stands for the cubic over 15 samples."""
    measured: Array
    """Measured output of the block, shape (n,)."""
    deviation: float
    """Unit of the residuals: the sensor's standard deviation, or a weight given by `Evidence`."""
    slack: float
    """Tolerance of the measurement's zero: a converter's step, or more where the encoder was zeroed
    on a muscle that a leak had filled a little."""
    start: float
    """Initial output of the block: atmospheric pressure, or the position at rest."""
    steps: int = STEPS_A_TICK
    has_position: bool = True
    """False for a pressure block whose position was not measured: the model then simulates it."""
    rows: NDArray[np.bool_] | None = None
    """The samples that count, shape (n,); None for all."""

    @property
    def samples(self) -> int:
        """Number of samples that count."""
        return len(self.measured) if self.rows is None else int(self.rows.sum())

    @property
    def channel(self) -> str:
        """The channel of the output."""
        return "pressure_pa" if self.block == PRESSURE else "position_m"

    @cached_property
    def grid(self) -> SampleGrid:
        """The simulation's steps."""
        return build_grid(self.step_s, len(self.measured), self.steps)

    def simulate(self, settings: PlantSettings) -> Array:
        """Simulate the block; return the output of its sensor without noise."""
        return self.simulate_with(plant_parameters(settings))

    def simulate_with(self, p: PlantParameters) -> Array:
        """Simulate the block with the kernels' parameters."""
        if not self.has_position:
            return drive_coupled(p, self.valve_v, self.grid).pressure_pa
        if self.block == PRESSURE:
            rests = self.start == p.atmospheric_pressure_pa
            start = None if rests else rest_state(p, float(self.driven[0]), self.start)
            return drive_pressure(p, self.valve_v, self.driven, self.grid, start=start).pressure_pa
        start = rest_state(p, self.start, p.atmospheric_pressure_pa) if self.start else None
        return drive_mechanics(p, self.driven, self.grid, start=start).position_m

    def resting_gauge_pa(self, settings: PlantSettings, samples: int) -> float:
        """Return the true gauge pressure that the valve leaves at rest."""
        p = plant_parameters(settings)
        if not (self.has_position and samples):
            return 0.0
        driven = drive_pressure(p, self.valve_v, self.driven, self.grid)
        resting_pa = driven.true_pressure_pa[samples // 2 : samples]
        return float(np.mean(resting_pa)) - p.atmospheric_pressure_pa

    def residual(self, settings: PlantSettings) -> Array:
        """Return measurement minus simulation, in deviations of the sensor, shape (samples,)."""
        return self.residual_of(self.simulate(settings))

    def residual_of(self, simulated: Array) -> Array:
        """Return measurement minus a simulated output, in deviations of the sensor."""
        most = RUNAWAY * self.deviation
        error = np.nan_to_num(self.measured - simulated, nan=most).clip(-most, most)
        if self.rows is not None:
            error = error[self.rows]
        if self.slack:
            error = error - np.clip(np.mean(error), -self.slack, self.slack)
        return error / self.deviation

    def random_generator(self, *key: int) -> np.random.Generator:
        """Return a random generator that is fixed by this record and the key."""
        return np.random.default_rng([crc32(self.measured.tobytes()), *key])

    def draw_disturbance(self, noise: Noise, replica: int) -> Array:
        """Draw noise of the driving signal, smoothed like the signal itself, shape (n,).

        The draws are kept: the floors of all models use the same noise.
        """
        if replica not in self._disturbances:
            drawn = noise.simulate_sensor(
                np.zeros(len(self.driven)), self.random_generator(replica, 0), self.driven
            )
            smooth = _smooth_signal(drawn, float(np.median(self.step_s)), self.cutoff_hz)
            self._disturbances[replica] = smooth
        return self._disturbances[replica]

    @cached_property
    def _disturbances(self) -> dict[int, Array]:
        return {}


def prepare_pressure_drive(record: Record, noises: dict[str, Noise], atmosphere_pa: float) -> Drive:
    """Prepare a record for the pressure block."""
    has_position = record.position_m is not None
    position_m = record["position_m"] if has_position else np.zeros(len(record))
    return Drive(
        PRESSURE,
        record.name,
        record.step_s,
        record["valve_v"],
        _smooth_signal(position_m, record.period_s, 0.0),
        0.0,
        record["pressure_pa"],
        max(noises["pressure_pa"].total, 1.0),
        0.0,
        _initial_pressure_pa(record, noises["pressure_pa"], atmosphere_pa),
        has_position=has_position,
        rows=record.counts,
    )


def prepare_mechanics_drive(
    record: Record,
    noises: dict[str, Noise],
    modelled_pa: Array | None = None,
    cutoff_hz: float = SMOOTH_HZ,
) -> Drive:
    """Prepare a record for the mechanical block.

    `modelled_pa` is the pressure block's simulation of the measured pressure. With it, only the
    difference is smoothed, so that steep flanks stay as they are.
    """
    noise = noises["position_m"]
    base = 0.0 if modelled_pa is None else modelled_pa
    return Drive(
        MECHANICS,
        record.name,
        record.step_s,
        np.zeros(len(record)),
        base + _smooth_signal(record["pressure_pa"] - base, record.period_s, cutoff_hz),
        cutoff_hz,
        record["position_m"],
        max(noise.total, 1e-7),
        noise.resolution,
        initial_position_m(record, noise),
        rows=record.counts,
    )


def contraction_m(settings: PlantSettings, gauge_pa: float) -> float:
    """Return how far a constant pressure moves a muscle from its vented rest."""
    p = plant_parameters(settings)
    steady_pa = np.full(SETTLED_MS, p.atmospheric_pressure_pa + gauge_pa)
    return float(drive_mechanics(p, steady_pa, 1e-3).position_m[-1])


def prepare_force_drive(record: Record, noises: dict[str, Noise]) -> Drive:
    """Prepare a record of a mechanism that a measured force drives, without a muscle."""
    noise = noises["position_m"]
    return Drive(
        MECHANICS,
        record.name,
        record.step_s,
        np.zeros(len(record)),
        _smooth_signal(record["force_n"], record.period_s, SMOOTH_HZ),
        SMOOTH_HZ,
        record["position_m"],
        max(noise.total, 1e-7),
        noise.resolution,
        initial_position_m(record, noise),
        rows=record.counts,
    )


def initial_position_m(record: Record, noise: Noise) -> float:
    """Return the initial position: zero, unless the encoder clearly shows another."""
    position_m = float(np.mean(record["position_m"][: max(min(record.rest_samples, 500), 1)]))
    return position_m if abs(position_m) > 3.0 * max(noise.resolution, 1e-6) else 0.0


def _initial_pressure_pa(record: Record, noise: Noise, atmosphere_pa: float) -> float:
    """Return the initial pressure: the atmosphere's, if within the sensor's tolerance."""
    count = max(min(record.rest_samples, 500), 1)
    pressure_pa = float(np.mean(record["pressure_pa"][:count]))
    near = abs(pressure_pa - atmosphere_pa) < max(VENTED_PA, 5.0 * noise.deviation)
    return atmosphere_pa if near else pressure_pa


def _smooth_signal(values: Array, period_s: float, cutoff_hz: float) -> Array:
    """Smooth without delay: second order in both directions, or a cubic over 15 samples."""
    if cutoff_hz == 0.0:
        cubic: Array = savgol_filter(values, 15, 3)
        return cubic
    relative = 2.0 * cutoff_hz * period_s
    if relative >= 0.9:
        return values
    # The ends are mirrored for a whole period. Otherwise the filter starts from a single noisy
    # sample, and the muscle at rest follows every pascal of it.
    mirrored = min(round(2.0 / relative), len(values) - 1)
    smooth: Array = sosfiltfilt(
        butter(2, relative, output="sos"), values, padtype="even", padlen=mirrored
    )
    return smooth


def stack_residuals(drives: Sequence[Drive], settings: PlantSettings) -> Array:
    """Return the residuals of several drives, one after the other."""
    p = plant_parameters(settings)
    return np.concatenate([drive.residual_of(drive.simulate_with(p)) for drive in drives])
