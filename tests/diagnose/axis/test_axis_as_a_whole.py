"""An axis that is simulated from its beginning: a fast oscillator, and a rest that is none."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.command_line import run_pamctl
from support.made_records import axis_plant, names_of, numbers_of

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.report.finding_words import list_faults
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.drive import drive_mechanics
from pamctl.plant.parameters import parameters_of

RATE_HZ, SAMPLES = 600.0, 2400
MASS_KG, DAMPING, STIFFNESS, CUBIC = 0.8, 12.0, 9000.0, 6e8


def held_force_n(seed: int) -> np.ndarray:
    random, hz = np.random.default_rng(seed), np.fft.rfftfreq(SAMPLES, 1.0 / RATE_HZ)
    lively = (hz > 0.5) & (hz < 60.0)
    waves = np.where(lively, np.exp(2j * np.pi * random.random(len(hz))), 0.0)
    force = np.fft.irfft(waves, SAMPLES)
    return np.asarray(9.0 * force / force.std())


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


@pytest.mark.long
def test_a_fast_oscillator_shows_its_cubic_spring_and_a_held_force_is_no_fault():
    guess = axis_plant(0.5 * MASS_KG, 0.5 * DAMPING, 0.5 * STIFFNESS)
    found = diagnose([oscillating(1)], [oscillating(2)], guess)
    assert names_of(found)[0] == "cubic_stiffness"
    values = numbers_of(found)
    assert values["mass_kg"] == pytest.approx(MASS_KG, rel=0.005)
    assert values["damping_n_s_per_m"] == pytest.approx(DAMPING, rel=0.005)
    assert values["stiffness_n_per_m"] == pytest.approx(STIFFNESS, rel=0.005)
    assert values["cubic_stiffness.n_per_m3"] == pytest.approx(CUBIC, rel=0.01)
    assert not list_faults(found)
    assert values["~apart.position_m"] == pytest.approx(0.5 / RATE_HZ, rel=0.05)


# --- a force that climbs to break-away while the encoder stands still ----------------------------

CARRIAGE_KG, COULOMB_N, NOISE_N = 10.0, 18.0, 0.5
STILL_S, LASTS_S, PERIOD_S = 4.0, 16.0, 1e-3
GUESS = """
actuator: direct
parameters: {mass_kg: 12.0, damping_n_s_per_m: 60.0, stiffness_n_per_m: 2000.0}
"""


def write_record(path: Path, seed: int, noise_n: float = NOISE_N) -> Path:
    """Write a log: the force swings within the friction's band and the noise, then beyond both."""
    random = np.random.default_rng(seed)
    t_s = PERIOD_S * np.arange(round(LASTS_S / PERIOD_S))
    phases = random.uniform(0.0, 2.0 * np.pi, 4)
    swings = sum(
        np.sin(2.0 * np.pi * f * t_s + phase) - np.sin(phase)
        for f, phase in zip((0.35, 0.8, 1.7, 2.9), phases, strict=True)
    )
    force_n = swings * np.where(t_s < STILL_S, 0.8 * (t_s / STILL_S) ** 2, 25.0)
    axis = parameters_of(
        {
            "actuator": 1.0,
            "mass_kg": CARRIAGE_KG,
            "damping_n_s_per_m": 40.0,
            "stiffness_n_per_m": 1500.0,
            "coulomb_friction.force_n": COULOMB_N,
        }
    )
    still_pa = np.full(len(t_s), axis.atmospheric_pressure_pa)
    position_m = drive_mechanics(axis, still_pa, PERIOD_S, force_n=force_n).position_m
    assert not position_m[t_s < STILL_S].any()
    columns = {
        "t_s": t_s,
        "force_n": force_n + random.normal(0.0, noise_n, len(t_s)),
        "position_m": np.round(position_m / 1e-6) * 1e-6,
    }
    csv = path.with_suffix(".csv")
    table = np.column_stack([*columns.values()])
    np.savetxt(csv, table, "%.9g", ",", header=",".join(columns), comments="")
    assert run_pamctl("log", "import", csv, path).returncode == 0
    return path


def diagnose_axis(tmp_path: Path) -> dict[str, Any]:
    (tmp_path / "guess.yaml").write_text(GUESS)
    logs = [write_record(tmp_path / f"{seed}.mcap", seed) for seed in (1, 2)]
    others = {*CATALOGUE} - {"coulomb_friction", "cubic_stiffness"}
    done = run_pamctl(
        *("diagnose", logs[0], "--holdout", logs[1], "--plant", tmp_path / "guess.yaml"),
        *("--out", tmp_path / "found", "--json"),
        *(word for name in sorted(others) for word in ("--without", name)),
    )
    assert done.returncode == 0, done.stderr
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def test_a_force_that_climbs_to_break_away_is_no_wandering_sensor(tmp_path):
    document = diagnose_axis(tmp_path)
    assert [effect["name"] for effect in document["effects"]] == ["coulomb_friction"]
    (force,) = document["effects"][0]["parameters"].values()
    assert force["value"] == pytest.approx(COULOMB_N, rel=0.02)
    assert document["recalibrated"]["mass_kg"]["value"] == pytest.approx(CARRIAGE_KG, rel=0.02)
    noise = document["noise"]["force_n"]
    assert noise["deviation"] == pytest.approx(NOISE_N, rel=0.1)
    assert "wanders" not in noise["faults"]
