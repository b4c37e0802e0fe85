"""FMUs in an importer that is not ours: a muscle and a chamber move as they do in pamctl."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import extract, read_model_description
from fmpy.fmi3 import FMU3Slave, fmi3LogMessageCallback
from fmpy.validation import validate_fmu
from support.command_line import run_pamctl, run_process
from typer.testing import CliRunner

from hal.calibration import Converter, calibration, output_v, quantise_v, valve_v
from hal.sim import sensor_chain
from pamctl.cli.app import app
from pamctl.control.experiment import plan_experiment
from pamctl.models.fmu import write_fmu
from pamctl.offline.closed_loop import (
    SimulatedRun,
    draw_sensor_noise,
    simulate,
    tabulate_references,
)
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings, plant_parameters, settings_of
from pamctl.plant.simulated import SimulatedPlant
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import resolve

PERIOD_S = 1e-3
POSITION, PRESSURE, TRUE_POSITION, VELOCITY = 2, 3, 4, 5


class Unit:
    """An FMU in FMPy, ready to step."""

    def __init__(self, path: Path, said: list[str] | None = None) -> None:
        described = read_model_description(path)
        self.slave = FMU3Slave(
            guid=described.instantiationToken,
            unzipDirectory=extract(path),
            modelIdentifier=described.coSimulation.modelIdentifier,
            instanceName="rig",
        )
        log = None if said is None else lambda *message: said.append(message[-1].decode())
        self.slave.instantiate(logMessage=log and fmi3LogMessageCallback(log))
        self.slave.enterInitializationMode(startTime=0.0)
        self.slave.exitInitializationMode()
        self.now_s = 0.0

    def step(self, command_v: float, step_s: float = PERIOD_S) -> None:
        self.slave.setFloat64([1], [command_v])
        self.slave.doStep(self.now_s, step_s)
        self.now_s += step_s

    def follow(self, commands_v: Any) -> Any:
        """Return position, pressure and velocity at each sample."""
        rows = np.empty((len(commands_v), 3))
        for row, command_v in zip(rows, commands_v, strict=True):
            row[:] = self.slave.getFloat64([POSITION, PRESSURE, VELOCITY])
            self.step(command_v)
        return rows.T


def export(path: Path, settings: PlantSettings | None = None) -> Path:
    write_fmu(settings or PlantSettings(), path)
    return path


@pytest.fixture(scope="module")
def paper_fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(tmp_path_factory.mktemp("fmu") / "paper.fmu")


def run_experiment_2() -> tuple[SimulatedRun, list[float]]:
    """Return experiment 2 on the paper's muscle under qSMC, and the commands that the card gives.

    It begins with the approach from the vented muscle.
    """
    settings = resolve(
        experiment="tracking-2", plant="paper", fast=True,
        overrides=["rig.homing.enabled=false", "rig.calibration.sensor_zero_v=0.215"],
    )  # fmt: skip
    rig: Any = settings.rig
    asked = tabulate_references(plan_experiment(settings.experiment).segments, PERIOD_S)
    run = simulate(
        build_tick_setup(settings),
        plant_parameters(settings.plant),
        sensor_chain(rig.sim, rig.calibration),
        asked,
        draw_sensor_noise(len(asked), seed=1),
    )
    assert run.tripped_tick < 0
    card, output = calibration(rig.calibration), Converter(10.0)
    given_v = [quantise_v(output, output_v(card, float(asked_v))) for asked_v in run["valve_v"]]
    return run, [valve_v(card, volts) for volts in given_v]


def test_the_importer_finds_no_fault_in_the_unit(paper_fmu):
    assert validate_fmu(str(paper_fmu)) == []
    described = read_model_description(paper_fmu)
    assert [v.name for v in described.modelVariables if v.causality == "input"] == ["command_v"]
    assert len(described.outputs) == 5
    values = {v.name: v.start for v in described.modelVariables}
    assert float(values["plant.stiffness_n_per_m"]) == PlantSettings().parameters.stiffness_n_per_m


def test_experiment_2_is_within_a_micrometre_of_ours_in_an_independent_importer(paper_fmu):
    ours, commands_v = run_experiment_2()
    position_m, pressure_pa, _ = Unit(paper_fmu).follow(commands_v)
    assert np.ptp(position_m) > 17e-3
    assert np.abs(position_m - ours["true_position_m"]).max() < 1e-9
    assert np.abs(pressure_pa - ours["true_pressure_pa"]).max() < 1e-3


def test_every_effect_moves_in_the_unit_as_in_our_plant(tmp_path):
    values = {
        f"{effect.name}.{number.name}": number.start
        for effect in CATALOGUE.values()
        if "muscle" in effect.actuators
        for number in effect.parameters
    }
    settings = settings_of(values)
    assert plant_parameters(settings).effects.timing.command_delay.delay_s > 0.0
    random = np.random.default_rng(3)
    commands_v = np.repeat(random.uniform(-3.0, 4.0, 12), 50)
    plant = SimulatedPlant(plant_parameters(settings))
    unit = Unit(export(tmp_path / "all.fmu", settings))
    moved_m = []
    for command_v in commands_v:
        shown = unit.slave.getFloat64([POSITION, PRESSURE])
        assert shown == [plant.position_m, plant.pressure_pa]
        moved_m.append(plant.position_m)
        plant.advance(command_v, PERIOD_S)
        unit.step(command_v)
    assert np.ptp(moved_m) > 1e-3


def test_a_state_is_taken_back_and_gone_on_from_and_survives_as_bytes(paper_fmu):
    unit = Unit(paper_fmu)
    for _ in range(200):
        unit.step(1.0)
    state, begin_s = unit.slave.getFMUState(), unit.now_s
    kept = unit.slave.serializeFMUState(state)
    ends = []
    for again in (state, unit.slave.deserializeFMUState(kept)):
        unit.slave.setFMUState(again)
        unit.now_s = begin_s
        for _ in range(50):
            unit.step(-2.0)
        ends.append(unit.slave.getFloat64([POSITION, PRESSURE]))
    assert ends[0] == ends[1]
    unit.slave.reset()
    assert unit.slave.getFloat64([TRUE_POSITION]) == [0.0]


def test_what_an_importer_must_not_do_is_refused_and_changes_nothing(paper_fmu):
    unit = Unit(paper_fmu)
    unit.step(1.0)
    before = unit.slave.getFloat64([POSITION, PRESSURE, 0])
    for wrong in (
        lambda: unit.slave.doStep(unit.now_s, 0.0),
        lambda: unit.slave.doStep(unit.now_s, float("nan")),
        lambda: unit.slave.setFloat64([1], [float("inf")]),
        lambda: unit.slave.setFloat64([POSITION], [1.0]),
        lambda: unit.slave.getFloat64([99]),
        lambda: unit.slave.getInt32([0]),
    ):
        with pytest.raises(Exception, match="status 3"):
            wrong()
    assert unit.slave.getFloat64([POSITION, PRESSURE, 0]) == before


def test_the_same_plant_gives_the_same_unit_and_its_sources_compile_without_a_warning(tmp_path):
    for name in ("one.fmu", "two.fmu"):
        write_fmu(PlantSettings(), tmp_path / name, sources_only=True)
    assert (tmp_path / "one.fmu").read_bytes() == (tmp_path / "two.fmu").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.fmu") as unit:
        assert "sources/buildDescription.xml" in unit.namelist()
        assert not any(name.startswith("binaries") for name in unit.namelist())
        unit.extractall(tmp_path)
    plant = tmp_path / "sources" / "plant.c"
    for gnu in (True, False):  # other compilers have none of GNU's extensions
        if not gnu:
            plant.write_text(plant.read_text().replace("__GNUC__", "NO_GNU"))
        command = ["cc", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wno-unused-parameter"]
        command += [] if gnu else ["-Wno-unused-function", "-Wno-unused-variable"]
        command += ["-Werror", "-fsyntax-only", "fmi3_interface.c"]
        done = run_process(command, cwd=plant.parent)
        assert done.returncode == 0, done.stderr[:2000]


def test_a_step_that_no_arithmetic_can_follow_fails_says_why_and_changes_nothing(paper_fmu):
    said: list[str] = []
    unit = Unit(paper_fmu, said)
    unit.step(1.0)
    before = unit.slave.getFloat64([0, POSITION, PRESSURE, VELOCITY])
    with pytest.raises(Exception, match="status 3"):
        unit.slave.doStep(unit.now_s, 1e300)  # the number of its parts is no integer of 64 bits
    assert said == ["the plant has left the range of its model"]
    assert unit.slave.getFloat64([0, POSITION, PRESSURE, VELOCITY]) == before
    unit.step(1.0)


def test_the_verb_writes_a_unit_or_says_what_is_wrong(tmp_path, monkeypatch):
    out = tmp_path / "a.fmu"

    def run(*arguments: object) -> Any:
        command = ["plant", "export", *map(str, arguments), "--json"]
        done = CliRunner().invoke(app, command)
        return done.exit_code, json.loads(done.stdout)

    assert run("paper", out, "--sources-only") == (
        0, {"plant": "paper", "fmu": str(out), "platform": None}
    )  # fmt: skip
    code, document = run("paper", out, "--sources-only")
    assert (code, "exists" in document["reason"]) == (2, True)
    code, document = run("paper", tmp_path / "b.zip")
    assert (code, "must end with .fmu" in document["reason"]) == (2, True)
    code, document = run("papr", tmp_path / "b.fmu")
    assert (code, "did you mean 'paper'" in document["reason"]) == (2, True)
    monkeypatch.setattr("pamctl.kernel.build.find_compiler", lambda: None)
    code, document = run("paper", tmp_path / "b.fmu")
    assert (code, "--sources-only" in document["reason"]) == (69, True)
    assert not (tmp_path / "b.fmu").exists()


# --- a chamber whose record holds a position too: all verbs agree --------------------------------

VOLUME_M3, GAIN_M2_PER_V, LEAK_M2 = 1e-3, 1e-6, 5e-8
NOISE_PA, SAMPLED_S = 200.0, 2e-3
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
        unit.doStep(k * SAMPLED_S, SAMPLED_S)
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
        t_s = SAMPLED_S * np.arange(len(commands_v))
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
