"""An oscillator of 17 Hz under a converter's force, sampled at 600 Hz: by an independent solver."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.made_records import names_of, numbers_of

from pamctl.diagnose import Diagnosis, Record, diagnose
from pamctl.diagnose.report.finding_words import list_faults
from pamctl.plant.model import PlantSettings

RATE_HZ, SAMPLES = 600.0, 2400
MASS_KG, DAMPING, STIFFNESS, CUBIC = 0.8, 12.0, 9000.0, 6e8


def held_force_n(seed: int) -> np.ndarray:
    random, hz = np.random.default_rng(seed), np.fft.rfftfreq(SAMPLES, 1.0 / RATE_HZ)
    lively = (hz > 0.5) & (hz < 60.0)
    waves = np.where(lively, np.exp(2j * np.pi * random.random(len(hz))), 0.0)
    force = np.fft.irfft(waves, SAMPLES)
    return np.asarray(9.0 * force / force.std())


@cache
def oscillating(seed: int) -> Record:
    force_n, tick_s = held_force_n(seed), 1.0 / RATE_HZ
    states = np.zeros((SAMPLES, 2))
    for k in range(SAMPLES - 1):

        def rates(t_s: float, xv: np.ndarray, n: float = force_n[k]) -> list[float]:
            spring_n = STIFFNESS * xv[0] + CUBIC * xv[0] ** 3
            return [xv[1], (n - DAMPING * xv[1] - spring_n) / MASS_KG]

        states[k + 1] = solve_ivp(rates, (0.0, tick_s), states[k], rtol=1e-8, atol=1e-10).y[:, -1]
    noise_m = np.random.default_rng(seed + 99).normal(0.0, 3e-6, SAMPLES)
    t_s = np.arange(SAMPLES) * tick_s
    return Record(name=f"run{seed}", t_s=t_s, force_n=force_n, position_m=states[:, 0] + noise_m)


@cache
def diagnose_oscillator() -> Diagnosis:
    guess = 0.5
    parameters = {
        "mass_kg": guess * MASS_KG,
        "damping_n_s_per_m": guess * DAMPING,
        "stiffness_n_per_m": guess * STIFFNESS,
    }
    plant = PlantSettings.model_validate({"actuator": "direct", "parameters": parameters})
    return diagnose([oscillating(1)], [oscillating(2)], plant)


@pytest.mark.long
def test_a_fast_oscillator_shows_its_cubic_spring_and_a_held_force_is_no_fault() -> None:
    found = diagnose_oscillator()
    assert names_of(found)[0] == "cubic_stiffness"
    values = numbers_of(found)
    assert values["mass_kg"] == pytest.approx(MASS_KG, rel=0.005)
    assert values["damping_n_s_per_m"] == pytest.approx(DAMPING, rel=0.005)
    assert values["stiffness_n_per_m"] == pytest.approx(STIFFNESS, rel=0.005)
    assert values["cubic_stiffness.n_per_m3"] == pytest.approx(CUBIC, rel=0.01)
    assert not list_faults(found)
    assert values["~apart.position_m"] == pytest.approx(0.5 / RATE_HZ, rel=0.05)
