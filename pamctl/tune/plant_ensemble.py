"""Plants that a rig built after the paper might turn out to be.

Every number that the paper gives is off by up to 20 %, and everything that it leaves out is
there to some degree: the valve's own dynamics, a dead band, delay, leaks, sensor noise and
friction that creeps before it slides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.random import Generator, default_rng

from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.paper import braid_lever_m, force_area_m2

PARAMETER_TOLERANCE = 0.2
"""Share by which the paper's parameters may be off, either way."""
UNCERTAIN_PARAMETERS = (
    "damping_n_s_per_m",
    "stiffness_n_per_m",
    "kinetic_friction_per_m",
    "valve_gain_m2_per_v",
)

VALVE_HZ = (60.0, 150.0)
VALVE_DAMPING = (0.5, 1.0)
DEADBAND_V = (0.0, 0.3)
"""Overlap of one side, as in the catalogue of effects: the band is up to 0.6 V wide in all."""
DELAY_S = (0.0, 2e-3)
LEAK_M2 = (1e-11, 3e-9)
PRESLIDING_N_PER_M = (5e4, 2e6)
NOISE_V = (0.0005, 0.004)
"""Noise of the pressure sensor; 0.002 V is about 300 Pa."""

FARTHEST_M = 17.2e-3
"""The upper set point of the paper's experiments. A plant that cannot hold it is not drawn."""
_FORCE_TO_SPARE = 1.15
_NOISES = 4
"""Number of different noise sequences: drawing one takes longer than simulating a run."""


@dataclass(frozen=True)
class Member:
    """One plant of an ensemble, with its sensor."""

    name: str
    plant: PlantSettings
    noise_v: float = 0.002
    output_delay_ticks: int = 0
    seed: int = 0

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to another process as text: the models of effects are made at run time."""
        rest = (self.name, self.noise_v, self.output_delay_ticks, self.seed)
        return _rebuild_member, (self.plant.model_dump_json(), *rest)


def _rebuild_member(plant: str, name: str, noise_v: float, delay_ticks: int, seed: int) -> Member:
    return Member(name, _parse_plant(plant), noise_v, delay_ticks, seed)


@lru_cache(maxsize=1024)
def _parse_plant(text: str) -> PlantSettings:
    return PlantSettings.model_validate_json(text)


def draw_ensemble(size: int, seed: int) -> list[Member]:
    """Draw plants; the same seed gives the same ones."""
    return [_draw_member(number, seed) for number in range(size)]


def make_fixed_members(plants: Sequence[tuple[str, PlantSettings]]) -> list[Member]:
    """Take plants as they are, each behind the simulated rig's own sensor."""
    return [Member(name, plant) for name, plant in plants]


def _draw_member(number: int, seed: int) -> Member:
    """Draw one plant. Each has a generator of its own: a larger ensemble only adds plants."""
    draw = default_rng([seed, number])
    for parameters in _draw_parameters(draw):
        plant = PlantSettings.model_validate(
            {"parameters": parameters, "effects": _draw_effects(draw)}
        )
        if holds_the_farthest_point(plant):
            break
    noise_v = float(draw.uniform(*NOISE_V))
    return Member(f"{seed}-{number}", plant, noise_v, seed=int(draw.integers(_NOISES)))


def _draw_parameters(draw: Generator) -> Iterator[dict[str, float]]:
    nominal = PlantSettings().parameters
    gauge_pa = nominal.tank_pressure_pa - nominal.atmospheric_pressure_pa
    while True:
        *factors, tank = draw.uniform(
            1.0 - PARAMETER_TOLERANCE, 1.0 + PARAMETER_TOLERANCE, len(UNCERTAIN_PARAMETERS) + 1
        ).tolist()
        yield {
            **{
                n: f * getattr(nominal, n)
                for n, f in zip(UNCERTAIN_PARAMETERS, factors, strict=True)
            },
            "tank_pressure_pa": nominal.atmospheric_pressure_pa + tank * gauge_pa,
        }


def _draw_effects(draw: Generator) -> dict[str, dict[str, Any]]:
    width_v = float(draw.uniform(*DEADBAND_V))
    skew = float(draw.uniform(0.7, 1.0))
    return {
        "valve_spool": {
            "time_constant_s": 1.0 / (2.0 * math.pi * float(draw.uniform(*VALVE_HZ))),
            "damping_ratio": float(draw.uniform(*VALVE_DAMPING)),
        },
        "valve_deadband": {"fill_width_v": width_v, "exhaust_width_v": skew * width_v},
        "command_delay": {"delay_s": float(draw.uniform(*DELAY_S))},
        "valve_leak": {"area_m2": _draw_log_uniform(draw, LEAK_M2)},
        "chamber_leak": {"area_m2": _draw_log_uniform(draw, LEAK_M2)},
        "presliding": {"compliance_m_per_n": 1.0 / _draw_log_uniform(draw, PRESLIDING_N_PER_M)},
    }


def _draw_log_uniform(draw: Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(draw.uniform(*np.log(bounds))))


def holds_the_farthest_point(plant: PlantSettings) -> bool:
    """Tell whether the tank's pressure can push the muscle to the upper set point."""
    p = plant_parameters(plant).paper
    gauge_pa = p.tank_pressure_pa - p.atmospheric_pressure_pa
    push_n = gauge_pa * force_area_m2(p, FARTHEST_M)
    friction_n = p.friction_area_m * gauge_pa * braid_lever_m(p, FARTHEST_M)
    return push_n > _FORCE_TO_SPARE * (p.stiffness_n_per_m * FARTHEST_M + friction_n)
