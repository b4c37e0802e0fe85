"""Play before a position sensor, where the mass is judged in windows from the measured state."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from support.made_records import names_of, numbers_of

from pamctl.diagnose import Diagnosis, Record, Verdict, diagnose
from pamctl.plant.drive import Restarts, drive_mechanics
from pamctl.plant.model import PlantSettings
from pamctl.plant.parameters import parameters_of

WIDTH_M = 0.25e-3
MASS_KG, DAMPING = 2.4, 31.0


def test_a_reading_that_moves_is_pushed_and_one_that_rests_keeps_its_side() -> None:
    """Without forces a mass goes on at its speed; its reading is half of the play behind."""
    p = parameters_of(
        {
            "actuator": 1.0,
            "mass_kg": 10.0,
            "damping_n_s_per_m": 1e-6,
            "stiffness_n_per_m": 0.0,
            "encoder_backlash.width_m": WIDTH_M,
        }
    )
    samples, begins, rests = 300, 100, 5
    still = np.full(samples, p.atmospheric_pressure_pa)
    force_n = np.full(samples, 20.0)
    free = drive_mechanics(p, still, 1e-3, force_n=force_n)
    assert free.position_m[rests] == 0.0 < free.true_position_m[rests] < 0.5 * WIDTH_M
    resting = Restarts(np.array([rests]), np.zeros(1), np.zeros(1))
    kept = drive_mechanics(p, still, 1e-3, force_n=force_n, restarts=resting)
    assert kept.true_position_m == pytest.approx(free.true_position_m, abs=1e-12)
    pushed = Restarts(np.array([begins]), np.array([0.3]), np.array([-0.7]))
    driven = drive_mechanics(p, still, 1e-3, force_n=0.0 * force_n, restarts=pushed)
    way_m = 0.3 - 0.7e-3 * np.arange(samples - begins)
    assert driven.position_m[begins:] == pytest.approx(way_m, abs=1e-6)
    assert driven.true_position_m[begins:] == pytest.approx(way_m - 0.5 * WIDTH_M, abs=1e-6)


def drive_belt(seed: int, width_m: float = WIDTH_M) -> Record:
    """Return 10 s at 200 Hz of a carriage on a belt: means of 10 samples, which hide the noise.

    The carriage's linear equation is solved exactly from sample to sample.
    """
    random, period_s, hz = np.random.default_rng(seed), 5e-4, random_tones(seed)
    t_s = np.arange(0.0, 10.0, period_s)
    wanted_m = (1.0 - np.exp(-t_s)) * sum(size * np.sin(2.0 * np.pi * f * t_s) for size, f in hz)
    kept = exp(-DAMPING / MASS_KG * period_s)
    x = v = shown = 0.0
    rows = np.empty((2, len(t_s)))
    for k, goal_m in enumerate(wanted_m):
        force_n = 900.0 * (goal_m - x) - 25.0 * v
        rows[:, k] = shown, force_n
        end = force_n / DAMPING
        x += end * period_s + (v - end) * (1.0 - kept) * MASS_KG / DAMPING
        v = end + (v - end) * kept
        shown = min(max(shown, x - 0.5 * width_m), x + 0.5 * width_m)
    rows += random.normal(0.0, [[2e-6], [0.12]], rows.shape)
    position_m, force_n = rows.reshape(2, -1, 10).mean(axis=2)
    return Record(f"belt {seed}", t_s[9::10], position_m=position_m, force_n=force_n)


def random_tones(seed: int) -> list[tuple[float, float]]:
    random = np.random.default_rng(1000 + seed)
    return [*zip(random.uniform(6e-3, 20e-3, 5), random.uniform(0.2, 2.2, 5), strict=True)]


def diagnose_belt() -> Diagnosis:
    records = [drive_belt(seed) for seed in (1, 2, 3, 4)]
    guess = PlantSettings.model_validate(
        {
            "actuator": "direct",
            "parameters": {
                "mass_kg": 2.0 * MASS_KG,
                "damping_n_s_per_m": 2.0 * DAMPING,
                "stiffness_n_per_m": 0.0,
            },
        }
    )
    return diagnose(records[:2], records[2:], guess)


def test_play_is_named_where_the_mass_is_judged_in_windows() -> None:
    found = diagnose_belt()
    assert names_of(found)[0] == "encoder_backlash"
    assert found.verdict is Verdict.NAMED
    values = numbers_of(found)
    assert values["encoder_backlash.width_m"] == pytest.approx(WIDTH_M, rel=0.05)
    assert values["mass_kg"] == pytest.approx(MASS_KG, rel=0.01)
    assert values["damping_n_s_per_m"] == pytest.approx(DAMPING, rel=0.03)
