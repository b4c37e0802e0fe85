"""Records of a mass without a spring, in closed form, for the tests of the diagnosis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


def imposed_motion(seed: int, *, period_s: float = 0.01, noise_n: float = 0.3) -> Record:
    """Move a piston to and fro at constant speeds; a load cell measures what it takes.

    F = c v + f sgn v + load, at a pressure of one atmosphere; the mass is too light to show.
    """
    t_s = np.arange(round(30.0 / period_s)) * period_s
    random = np.random.default_rng(seed)
    ends_s = np.concatenate([[0.0], np.cumsum(random.uniform(1.5, 4.0, 20))])
    speeds = random.uniform(5e-3, 15e-3, 20) * (-1.0) ** np.arange(20)
    v = speeds[np.searchsorted(ends_s, t_s, "right") - 1]
    x = np.concatenate([[0.0], np.cumsum(v[:-1])]) * period_s
    force_n = 400.0 * v + 6.0 * np.sign(v) + 2.0 + random.normal(0.0, noise_n, len(t_s))
    return Record(
        f"imposed-{seed}",
        t_s,
        position_m=x + random.normal(0.0, 1e-5, len(t_s)),
        force_n=force_n,
    )


def leave_gaps(record: Record, *gaps: tuple[int, int]) -> Record:
    """Return a record without the samples [start, stop) of each gap."""
    kept: NDArray[np.bool_] = np.ones(len(record), dtype=bool)
    for start, stop in gaps:
        kept[start:stop] = False
    channels = {name: record[name][kept] for name in record.channels}
    return Record(record.name, record.t_s[kept], **channels)
