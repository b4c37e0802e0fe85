"""Rigs without a muscle: what a verb cannot do is refused, and what it leaves out is said."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run_pamctl
from support.made_records import COUNT_M

from pamctl.offline.closed_loop import simulate_run
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.drive import drive_coupled, drive_mechanics
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.settings.resolve import read_section_file, resolve

CHAMBER = "actuator: chamber\nchamber_volume_m3: 1.0e-3\n"
AXIS = """
actuator: direct
parameters: {mass_kg: 2.0, damping_n_s_per_m: 30.0, stiffness_n_per_m: 500.0}
"""


def invoke(*words: object) -> Any:
    done = run_pamctl(*words, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def import_columns(path: Path, columns: dict[str, Any]) -> Path:
    table = np.column_stack([*columns.values()])
    csv = path.with_suffix(".csv")
    np.savetxt(csv, table, "%.9g", ",", header=",".join(columns), comments="")
    invoke("log", "import", csv, path)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Plant files and a log of each, with columns that their models do not read."""
    folder = tmp_path_factory.mktemp("others")
    for name, text in (("chamber", CHAMBER), ("axis", AXIS)):
        (folder / f"{name}.yaml").write_text(text)
    random, t_s = np.random.default_rng(1), 1e-3 * np.arange(6000)
    command_v = np.repeat(random.uniform(-4.0, 4.0, 30), 200)
    chamber = plant_parameters(read_section_file("plant", folder / "chamber.yaml"))
    import_columns(
        folder / "chamber.mcap",
        {
            "t_s": t_s,
            "valve_v": command_v,
            "pressure_pa": drive_coupled(chamber, command_v, 1e-3).pressure_pa
            + random.normal(0.0, 200.0, 6000),
        },
    )
    force_n = 8.0 * np.sin(2.0 * np.pi * (0.3 + 0.4 * t_s) * t_s)
    axis = plant_parameters(read_section_file("plant", folder / "axis.yaml"))
    still_pa = np.full(6000, axis.atmospheric_pressure_pa)
    moved_m = drive_mechanics(axis, still_pa, 1e-3, force_n=force_n).position_m
    import_columns(
        folder / "axis.mcap",
        {
            "t_s": t_s,
            "valve_v": command_v,
            "force_n": force_n + random.normal(0.0, 0.01, 6000),
            "position_m": moved_m + random.normal(0.0, 2e-6, 6000),
        },
    )
    return folder


@pytest.mark.parametrize(
    ("plant", "way_on"),
    [
        ("chamber", "`pamctl plant export PLANT.yaml PLANT.fmu`"),
        ("axis", "plant.drive_n_per_v is missing"),
    ],
)
@pytest.mark.parametrize("verb", ["run --fast --log {0}/r.mcap", "tune --law pid --out {0}/g.yaml"])
def test_a_plant_that_nothing_can_drive_is_refused_before_a_run(plant, way_on, verb, folder):
    done = run_pamctl(*verb.format(folder).split(), "--plant", folder / f"{plant}.yaml")
    assert done.returncode == 78
    assert way_on in done.stderr
    assert not [*folder.glob("r*.mcap"), *folder.glob("g*.yaml")]


def test_a_command_beside_a_mechanism_is_said_to_be_unused(folder):
    others = {*CATALOGUE} - {"cubic_stiffness"}
    leave_out = [word for name in sorted(others) for word in ("--without", name)]
    plant = ("--plant", folder / "axis.yaml")
    found = run_pamctl("diagnose", folder / "axis.mcap", *plant, "--out", folder / "d", *leave_out)
    assert found.returncode == 0, found.stderr
    assert "valve_v is not used: a model with actuator: direct reads force_n" in found.stdout
    assert "valve_v is not used" in run_pamctl("compare", folder / "axis.mcap", *plant).stdout


@pytest.mark.parametrize("plant", ["chamber", "axis"])
def test_an_audit_has_a_word_for_every_effect_of_the_catalogue(plant, folder):
    audit = invoke("audit", folder / f"{plant}.mcap", "--plant", folder / f"{plant}.yaml")
    told = [
        *audit["sees"],
        *(spot["name"] for key in ("blind_spots", "unasked") for spot in audit[key]),
    ]
    assert sorted(told) == sorted(CATALOGUE)
    assert all(spot["why"] for spot in audit["unasked"])
    elsewhere = {"chamber": "coulomb_friction", "axis": "chamber_leak"}[plant]
    (why,) = (spot["why"] for spot in audit["unasked"] if spot["name"] == elsewhere)
    assert why == "this plant and its records have nothing that it acts on"


def test_an_audit_reads_a_measured_file_and_its_map_as_a_diagnosis_does(folder):
    plant = ("--plant", folder / "chamber.yaml")
    other = folder / "other.asc"
    rows = (folder / "chamber.csv").read_text().splitlines()
    other.write_text("\n".join(["a,b,c", *rows[1:]]))
    keys = "time: {column: a}\nvalve: {column: b}\npressure: {column: c, unit: Pa, gauge: false}\n"
    (folder / "map.yaml").write_text(keys)
    of_log = invoke("audit", folder / "chamber.mcap", *plant)
    assert invoke("audit", folder / "chamber.csv", *plant) == of_log
    assert invoke("audit", other, "--map", folder / "map.yaml", *plant) == of_log


@pytest.fixture(scope="module")
def of_a_muscle() -> Any:
    return invoke("audit", "diagnosis")


@pytest.mark.long
def test_what_is_said_of_the_moving_mass_follows_from_the_plant_at_hand(of_a_muscle, tmp_path):
    """The size from which it shows is that of two finely stepped plants side by side."""
    heavy = tmp_path / "heavy.yaml"
    heavy.write_text("parameters: {mass_kg: 2.2}\n")
    light_spot, heavy_spot = (
        next(spot for spot in audit["blind_spots"] if spot["name"] == "moving_mass")
        for audit in (of_a_muscle, invoke("audit", "square-1", "--plant", heavy))
    )
    assert "M / c = 0.088 ms" in light_spot["why"]
    assert "M / c = 3.9 ms" in heavy_spot["why"]
    assert "no experiment" not in light_spot["why"]
    settings = PlantSettings.model_validate({"effects": {"moving_mass": {"added_kg": 0.03}}})
    command_v = simulate_run(resolve(experiment="diagnosis"))["valve_v"]
    heavy_m, light_m = (
        drive_coupled(plant_parameters(s), command_v, 1e-3, steps=16).position_m
        for s in (settings, PlantSettings())
    )
    apart_m = float(np.sqrt(np.mean((heavy_m - light_m) ** 2)))
    seen_m = np.sqrt(0.05 / 0.95) * COUNT_M / np.sqrt(12.0)  # a twentieth of the encoder's steps
    assert light_spot["visible_from"] == pytest.approx(0.03 * seen_m / apart_m, rel=0.5)
