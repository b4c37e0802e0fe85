"""Records of a mass without a spring, in closed form, for the tests of the diagnosis."""

from __future__ import annotations

import numpy as np

from pamctl.diagnose import Record
from pamctl.plant.model import PlantSettings

MASS_KG, DAMPING, FRICTION_N, LOAD_N = 95.11, 203.5, 20.39, -3.16
"""The published answer of the ball-screw benchmark EMPS (Janot, Gautier, Brunot, 2019)."""


def axis(
    factor: float = 1.0,
    stiffness: float = 0.0,
    mass_kg: float = MASS_KG,
    **effects: dict[str, float],
) -> PlantSettings:
    """Return a direct mechanism whose mass and damping are a multiple of the true ones."""
    parameters = {
        "mass_kg": factor * mass_kg,
        "damping_n_s_per_m": factor * DAMPING,
        "stiffness_n_per_m": stiffness,
        "rest_length_m": 2.0,
        "braid_length_m": 2.4,
    }
    return PlantSettings.model_validate(
        {"actuator": "direct", "parameters": parameters, "effects": effects}
    )


def pushed_mass(
    seed: int,
    *,
    duration_s: float = 6.0,
    period_s: float = 1e-3,
    force_noise_n: float = 0.5,
    position_noise_m: float = 1e-6,
    stiffness: float = 0.0,
    damping_per_m: float = 0.0,
) -> Record:
    """Push a mass to and fro so that its motion is a sum of sines; the force balances it exactly.

    M x'' + (c + c_1 x) x' + k x + f sgn x' + load = F, without any simulation.
    """
    t_s = np.arange(round(duration_s / period_s)) * period_s
    random = np.random.default_rng(seed)
    x, v, a = np.zeros((3, len(t_s)))
    for hz, amplitude_m in ((0.4, 0.08), (1.1, 0.015)):
        w, phase = 2.0 * np.pi * hz, random.uniform(0.0, 2.0 * np.pi)
        x += amplitude_m * np.sin(w * t_s + phase)
        v += amplitude_m * w * np.cos(w * t_s + phase)
        a -= amplitude_m * w**2 * np.sin(w * t_s + phase)
    force_n = (
        MASS_KG * a
        + (DAMPING + damping_per_m * x) * v
        + stiffness * x
        + FRICTION_N * np.sign(v)
        + LOAD_N
    )
    return Record(
        f"pushed-{seed}",
        t_s,
        position_m=x + random.normal(0.0, position_noise_m, len(t_s)),
        force_n=force_n + random.normal(0.0, force_noise_n, len(t_s)),
    )
