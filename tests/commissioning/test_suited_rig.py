"""`pamctl plant rig`: a rig file whose limits suit what moves."""

from pathlib import Path
from typing import Any

import pytest
from support.command_line import run_pamctl

from pamctl.commissioning.suited_rig import make_rig_file, simulate_reach
from pamctl.plant.model import PlantSettings
from pamctl.plant.paper import braid_lever_m, force_area_m2
from pamctl.plant.parameters import parameters_of
from pamctl.settings.resolve import read_section_file, resolve
from pamctl.settings.yaml12 import parse_yaml

CYLINDER = """
actuator: cylinder
cylinder_area_m2: 4.9e-4
cylinder_volume_m3: 3.0e-5
stroke_m: 0.1
parameters:
  {mass_kg: 1.2, damping_n_s_per_m: 80, stiffness_n_per_m: 1500, tank_pressure_pa: 701300}
"""
LONG_MUSCLE = """
base: paper
parameters:
  {rest_length_m: 0.3, braid_length_m: 0.319, braid_turns: 1.74, mass_kg: 2.0,
   stiffness_n_per_m: 3000.0, tank_pressure_pa: 701300}
"""
PLANTS = {"cylinder": CYLINDER, "muscle": LONG_MUSCLE}


def read_limits(text: str) -> Any:
    return parse_yaml(text, Path("rig.yaml")).data["limits"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in PLANTS.items():
        (tmp_path / f"{name}.yaml").write_text(text)
    return tmp_path


@pytest.mark.parametrize("name", PLANTS)
def test_open_loop_fills_stay_within_the_limits_that_were_made_for_the_plant(folder, name):
    run = ("run", "--fast", "--quiet", "--experiment", "diagnosis", "--plant", f"{name}.yaml")
    tripped = run_pamctl(*run, "--log", "trips.mcap", cwd=folder)
    assert tripped.returncode == 4
    assert "`pamctl plant rig PLANT.yaml RIG.yaml`" in tripped.stderr
    made = run_pamctl("plant", "rig", f"{name}.yaml", "rig.yaml", cwd=folder)
    assert (
        f"next: pamctl run --fast --experiment diagnosis --plant {name}.yaml --rig rig.yaml"
        in made.stdout
    )
    done = run_pamctl(*run, "--rig", "rig.yaml", "--log", "ends.mcap", cwd=folder)
    assert done.returncode == 0, done.stderr


def test_a_trip_of_the_muscle_that_the_rig_file_is_for_gets_no_such_hint(tmp_path):
    low = ("--set", "rig.limits.pressure_pa=443e3", "--set", "rig.limits.stroke_high_mm=26")
    run = ("run", "--fast", "--quiet", "--experiment", "step")
    tight = ("--set", "rig.limits.tracking_error_mm=0.02", "--log", "t.mcap")
    tripped = run_pamctl(*run, *low, *tight, cwd=tmp_path)
    assert tripped.returncode == 4, tripped.stderr
    assert "plant rig" not in tripped.stderr


def test_the_stroke_ends_where_full_pressure_and_spring_balance_within_the_friction():
    plant = read_section_file("plant", Path("config/plant/paper.yaml"))
    p = parameters_of({}).paper
    at_m = simulate_reach(plant, 5.0).highest_m
    gauge_pa = p.tank_pressure_pa - p.atmospheric_pressure_pa
    pull_n = gauge_pa * force_area_m2(p, at_m)
    friction_n = gauge_pa * p.friction_area_m * braid_lever_m(p, at_m)
    assert pull_n - friction_n < 1.02 * p.stiffness_n_per_m * at_m < 1.02 * pull_n


def test_for_the_paper_s_muscle_the_limits_are_near_the_shipped_ones():
    shipped = resolve(fast=True)
    made = read_limits(make_rig_file(shipped.plant, "paper", "sim")[0])
    for key in ("pressure_pa", "stroke_high_mm", "tracking_error_mm", "pressure_model_pa"):
        assert made[key] == pytest.approx(getattr(shipped.rig.limits, key), rel=0.25), key


def test_a_limit_says_by_how_much_it_is_beyond_what_moves_and_speaks_of_no_muscle():
    stops = PlantSettings.model_validate(parse_yaml(CYLINDER, Path("c.yaml")).data)
    text, _ = make_rig_file(stops, "c.yaml", "sim")
    assert "0.1 of the stroke beyond both ends of a simulated fill" in text
    assert "2 times the fastest of a simulated fill" in text
    assert "muscle" not in text


def test_a_real_rig_keeps_its_sensor_and_is_told_where_it_cannot_show_the_pressure():
    strong = PlantSettings.model_validate(
        {"actuator": "muscle", "parameters": {"tank_pressure_pa": 1.1e6}}
    )
    text, notes = make_rig_file(strong, "strong", "nidaq")
    simulated, of_simulated = make_rig_file(strong, "strong", "sim")
    shipped = resolve(fast=True).rig.calibration.sensor_pa_per_v
    slopes = [
        parse_yaml(t, Path("r.yaml")).data["calibration"]["sensor_pa_per_v"]
        for t in (text, simulated)
    ]
    assert slopes[0] == shipped < slopes[1]
    assert any("cannot show" in note for note in notes)
    assert any("pamctl doctor" in note for note in notes)
    assert not of_simulated


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("paper", "rig.txt"), "must end in .yaml"),
        (("paper", "rig.yaml", "--backend", "moog"), "'moog' is not one of sim"),
        (("nope", "rig.yaml"), "nope"),
        (("chamber.yaml", "rig.yaml"), "does not move"),
    ],
)
def test_what_cannot_have_a_rig_file_is_refused_and_nothing_is_written(tmp_path, words, told):
    (tmp_path / "chamber.yaml").write_text("actuator: chamber\nchamber_volume_m3: 1.0e-3\n")
    done = run_pamctl("plant", "rig", *words, cwd=tmp_path)
    assert done.returncode in (2, 78)
    assert told in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["chamber.yaml"]
