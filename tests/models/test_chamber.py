"""A chamber whose record holds a position too: all verbs agree with an independent importer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import extract, read_model_description
from fmpy.fmi3 import FMU3Slave
from support.command_line import run_pamctl

from pamctl.plant.catalogue import CATALOGUE

VOLUME_M3, GAIN_M2_PER_V, LEAK_M2 = 1e-3, 1e-6, 5e-8
NOISE_PA, PERIOD_S = 200.0, 2e-3
PRESSURE = 3
PLANT = f"""
actuator: chamber
chamber_volume_m3: {VOLUME_M3}
parameters: {{valve_gain_m2_per_v: {GAIN_M2_PER_V}}}
"""


def invoke(command: str) -> Any:
    done = run_pamctl(*command.split(), "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def run_unit(path: Path, commands_v: Any) -> Any:
    """Return the pressure that FMPy computes at each sample."""
    described = read_model_description(path)
    unit = FMU3Slave(
        guid=described.instantiationToken,
        unzipDirectory=extract(path),
        modelIdentifier=described.coSimulation.modelIdentifier,
        instanceName="chamber",
    )
    unit.instantiate()
    unit.enterInitializationMode(startTime=0.0)
    unit.exitInitializationMode()
    shown_pa = np.empty(len(commands_v))
    for k, command_v in enumerate(commands_v):
        shown_pa[k] = unit.getFloat64([PRESSURE])[0]
        unit.setFloat64([1], [command_v])
        unit.doStep(k * PERIOD_S, PERIOD_S)
    return shown_pa


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make records of a leaking chamber, a constant or a moving position beside them."""
    folder = tmp_path_factory.mktemp("chamber")
    (folder / "guess.yaml").write_text(PLANT)
    (folder / "leaking.yaml").write_text(
        f"{PLANT}effects: {{chamber_leak: {{area_m2: {LEAK_M2}}}}}"
    )
    invoke(f"plant export {folder}/leaking.yaml {folder}/leaking.fmu")
    for name, moves in (("still", 0.0), ("resting", 0.0), ("moving", 0.01)):
        random = np.random.default_rng(len(name))
        held_v = np.repeat(random.choice([-5, 5, 2, -2, 0.5, -0.5, 0, 0], 20), 200)
        commands_v = np.concatenate([np.full(400, -5.0), held_v])
        t_s = PERIOD_S * np.arange(len(commands_v))
        columns = {
            "t_s": t_s,
            "valve_v": commands_v,
            "pressure_pa": run_unit(folder / "leaking.fmu", commands_v)
            + random.normal(0.0, NOISE_PA, len(t_s)),
            "position_m": 0.03 + moves * np.sin(t_s),
        }
        np.savetxt(
            folder / f"{name}.csv", np.column_stack([*columns.values()]), "%.9g", ",",
            header=",".join(columns), comments="",
        )  # fmt: skip
        invoke(f"log import {folder}/{name}.csv {folder}/{name}.mcap")
    return folder


@pytest.mark.parametrize("name", ["still", "moving"])
def test_a_chamber_beside_a_position_agrees_with_its_fmu_to_the_noise(folder, name):
    document = invoke(f"compare {folder}/{name}.mcap --plant {folder}/leaking.yaml")
    (compared,) = document["plants"]
    for way in ("coupled", "pressure_block"):
        assert compared["gap"][way]["pressure_pa"]["rms"] == pytest.approx(NOISE_PA, rel=0.05)
        assert compared["gap"][way]["position_m"]["rms"] is None
    (said,) = compared["unused"]
    assert said.startswith("position_m is not used")


def test_a_diagnosis_beside_a_position_finds_the_leak_and_the_gain_of_the_chamber(folder):
    others = {*CATALOGUE} - {"chamber_leak", "valve_deadband"}
    leave_out = " ".join(f"--without {name}" for name in sorted(others))
    document = invoke(
        f"diagnose {folder}/still.mcap --holdout {folder}/resting.mcap "
        f"--plant {folder}/guess.yaml --out {folder}/found {leave_out}"
    )
    (effect,) = document["effects"]
    area, gain = effect["parameters"]["area_m2"], document["recalibrated"]["valve_gain_m2_per_v"]
    assert area["value"] == pytest.approx(LEAK_M2, rel=0.01)
    assert gain["value"] == pytest.approx(GAIN_M2_PER_V, rel=0.001)
    assert document["gap"]["pressure_pa"]["extended"] == pytest.approx(NOISE_PA, rel=0.05)
    assert document["noise"]["position_m"]["faults"] == ["unused"]
