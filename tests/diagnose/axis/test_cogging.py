"""An axis whose drive cogs, positioned to rests and ramps, by a simulation of its own."""

from __future__ import annotations

from math import copysign, pi, sin

import numpy as np
import pytest

from pamctl.diagnose import Record
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.weigh import list_pool, prepare_weigher
from pamctl.plant.model import PlantSettings

MASS_KG, DAMPING, DRY_N, COGGING_N, PITCH_M = 3.1, 28.0, 1.5, 3.2, 0.016
PERIOD_S, STEPS, LASTS_S = 1e-3, 10, 10.0


def positioned(seed: int, cogging_n: float = COGGING_N) -> Record:
    """Let a stiff controller bring the axis from place to place; the force is measured."""
    random, dt_s = np.random.default_rng(seed), PERIOD_S / STEPS
    x, v, force, aim, goal = 0.05, 0.0, 0.0, 0.05, 0.05
    rows = np.empty((round(LASTS_S / PERIOD_S), 2))
    for k in range(len(rows)):
        if k % 500 == 0:
            goal = random.uniform(0.02, 0.25)
        aim += (goal - aim) * PERIOD_S / 0.06
        rows[k] = force, x
        wanted = 3000.0 * (aim - x) - 110.0 * v
        for _ in range(STEPS):
            force += dt_s * (wanted - force) / 0.002
            pushes = force - DAMPING * v - cogging_n * sin(2.0 * pi * x / PITCH_M + 0.4)
            free, most = v + dt_s * pushes / MASS_KG, dt_s * DRY_N / MASS_KG
            v = 0.0 if abs(free) <= most else free - copysign(most, free)
            x += dt_s * v
    force_n, position_m = rows.T
    return Record(
        f"positioned-{seed}",
        np.arange(len(rows)) * PERIOD_S,
        force_n=force_n + random.normal(0.0, 0.1, len(rows)),
        position_m=np.round(position_m / 1e-6) * 1e-6,
    )


@pytest.mark.parametrize("seeds", [(1, 2), (3, 4), (5, 6)])
def test_the_period_of_cogging_is_found_from_what_it_does_to_a_free_mass(
    seeds: tuple[int, ...],
) -> None:
    parameters = {"mass_kg": 3.0, "damping_n_s_per_m": 22.0, "stiffness_n_per_m": 0.0}
    dry = {"coulomb_friction": {"force_n": 1.0}}
    plant = PlantSettings.model_validate(
        {"actuator": "direct", "parameters": parameters, "effects": dry}
    )
    weigher, start = prepare_weigher([positioned(seed) for seed in seeds], (), plant)
    assert weigher.train.windowed
    pool = {h.name: h for h in list_pool(weigher.train, weigher.base, plant)}
    base = weigher.settle(start)
    (wave,) = NameSearch(weigher, pool).score(base, ["force~wave(position)"])
    assert wave.variant.shapes[0].value == pytest.approx(PITCH_M, rel=0.02)
