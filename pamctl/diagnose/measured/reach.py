"""How far a machine reaches: its force, travel, speed and pressure, the units of every range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from pamctl.diagnose.measured.record import Array, Record
from pamctl.plant.model import PlantSettings

LONGEST_S = 0.25
"""The speed is the way over a time that grows to this where noise would hide a shorter way."""
SPEED_OVER_NOISE = 100.0
"""Wanted way over its noise."""


@dataclass(frozen=True)
class Reach:
    """What a machine or its records reach, all positive, in SI."""

    force_n: float
    travel_m: float
    speed_m_per_s: float
    pressure_pa: float
    """Gauge."""
    least_way_m: float = 0.0
    """The smallest way that the position sensor shows beyond its noise; 0 where unknown."""
    load_n: float = 0.0
    """The largest force, constant loads included."""
    has_force: bool = True
    """Whether a force was measured. A motion and a pressure alone show ratios of forces only."""

    def size_of(self, unit: str) -> float:
        """Return the usual size of a quantity of a mechanical unit; raise KeyError for another."""
        force, way, speed = self.force_n, self.travel_m, self.speed_m_per_s
        return {
            "N": force,
            "m": way,
            "m/s": speed,
            "kg": force * way / speed**2,
            "N/m": force / way,
            "N/m3": force / way**3,
            "m/N": way / force,
            "N s/m": force / speed,
            "N/Pa": force / self.pressure_pa,
            "m2": force / self.pressure_pa,
            "N s/(m Pa)": force / (speed * self.pressure_pa),
            "m3": force / self.pressure_pa * way,
        }[unit]


def reach_of_muscle(plant: PlantSettings) -> Reach:
    """Return the reach of a muscle between the atmosphere and its tank (Eq. 2 and 3)."""
    p = plant.parameters
    gauge_pa = p.tank_pressure_pa - p.atmospheric_pressure_pa
    area_m2 = (3.0 * p.rest_length_m**2 - p.braid_length_m**2) / (4.0 * pi * p.braid_turns**2)
    travel_m = p.rest_length_m - p.braid_length_m / sqrt(3.0)
    # The same valve time for any muscle: it fills within a second.
    return Reach(area_m2 * gauge_pa, travel_m, travel_m, gauge_pa)


def measure_reach(
    records: Sequence[Record], plant: PlantSettings, noise_m: float, resolution_m: float
) -> Reach:
    """Return the reach of a direct mechanism in its records.

    A channel that was not measured, or that rests, counts as the smallest positive number that
    keeps ratios finite.
    """
    piston = plant.effects.model_dump().get("piston") or {"area_m2": 0.0}
    atmosphere_pa = plant.parameters.atmospheric_pressure_pa
    spans, loads, ways, speeds, pressures = [], [], [], [], []
    for record in records:
        pressed_n = np.zeros(len(record))
        if record.pressure_pa is not None:
            gauge_pa = record.pressure_pa - atmosphere_pa
            pressures.append(_largest(gauge_pa))
            pressed_n = abs(piston["area_m2"]) * gauge_pa
        force_n = record.force_n if record.force_n is not None else pressed_n
        spans.append(0.5 * _span(force_n))
        loads.append(max(_largest(force_n), _largest(pressed_n)))
        if record.position_m is not None:
            ways.append(_span(record.position_m))
            speeds.append(_usual_speed(record, record.position_m, noise_m))
    return Reach(
        force_n=max(*spans, 1e-9),
        travel_m=max(*ways, 1e-9) if ways else 1.0,
        speed_m_per_s=max(*speeds, 1e-9) if speeds else 1.0,
        pressure_pa=max(*pressures, 1.0) if pressures else atmosphere_pa,
        least_way_m=4.0 * max(noise_m, resolution_m),
        load_n=max(*loads, 1e-9),
        has_force=any(record.force_n is not None for record in records),
    )


def _span(values: Array) -> float:
    low, high = np.quantile(values, [0.001, 0.999])
    return float(high - low)


def _largest(values: Array) -> float:
    return float(np.quantile(np.abs(values), 0.999))


def _usual_speed(record: Record, position_m: Array, noise_m: float) -> float:
    """Return a speed that is exceeded for a hundredth of the time only."""
    samples = 1
    while True:
        way_m = float(np.quantile(np.abs(position_m[samples:] - position_m[:-samples]), 0.99))
        took_s = samples * record.period_s
        if way_m > SPEED_OVER_NOISE * noise_m or 2.0 * took_s > LONGEST_S:
            return way_m / took_s
        samples *= 2
