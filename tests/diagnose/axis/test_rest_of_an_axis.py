"""An axis whose force climbs to break-away while its encoder stands still: that is no rest."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run_pamctl

from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.drive import drive_mechanics
from pamctl.plant.parameters import parameters_of

MASS_KG, COULOMB_N, NOISE_N = 10.0, 18.0, 0.5
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
            "mass_kg": MASS_KG,
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


def test_a_force_that_climbs_to_break_away_is_no_wandering_sensor(tmp_path: Path) -> None:
    document = diagnose_axis(tmp_path)
    assert [effect["name"] for effect in document["effects"]] == ["coulomb_friction"]
    (force,) = document["effects"][0]["parameters"].values()
    assert force["value"] == pytest.approx(COULOMB_N, rel=0.02)
    assert document["recalibrated"]["mass_kg"]["value"] == pytest.approx(MASS_KG, rel=0.02)
    noise = document["noise"]["force_n"]
    assert noise["deviation"] == pytest.approx(NOISE_N, rel=0.1)
    assert "wanders" not in noise["faults"]
