"""`pamctl plant new`: numbers as datasheets have them become a plant file in SI."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.plant.model import PlantSettings
from pamctl.plant.paper import MuscleParameters
from pamctl.settings.datasheet import DatasheetError, list_questions, read_quantity
from pamctl.settings.resolve import read_section_file, resolve

AIR = {"atmospheric_pressure_pa": 94e3}


def make(*options: str) -> Any:
    return CliRunner().invoke(app, ["plant", "new", *options])


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("rest_length_m", "0.2 m", 0.2),
        ("rest_length_m", "200 mm", 0.2),
        ("rest_length_m", "0,2", 0.2),
        ("tank_pressure_pa", "6 bar gauge", 694e3),
        ("tank_pressure_pa", "700 kPa abs", 700e3),
        ("tank_pressure_pa", "6 barg", 694e3),
        ("tank_pressure_pa", "441300", 441300.0),
        ("piston.area_m2", "25 mm bore", math.pi * 0.025**2 / 4.0),
        ("piston.area_m2", "4.91 cm2", 4.91e-4),
        ("chamber_volume_m3", "2 l", 2e-3),
        ("mass_kg", "95e3 g", 95.0),
        ("stiffness_n_per_m", "9.68 N/mm", 9680.0),
        ("damping_n_s_per_m", "570 Ns/m", 570.0),
        ("temperature_k", "20 \N{DEGREE SIGN}C", 293.15),
        ("valve_gain_m2_per_v", "1.03 mm2/V", 1.03e-6),
    ],
)
def test_a_number_with_its_unit_is_read_in_si(name, text, value):
    assert read_quantity(name, text, AIR) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("rest_length_m", "200 kg", "give m, mm, cm, um, in"),
        ("rest_length_m", "long", "is no number"),
        ("tank_pressure_pa", "6 bar", "each with `gauge`"),
        ("piston.area_m2", "25 mm", "or `25 mm bore`"),
        ("braid_length_m", "60 deg", "up to 54.7 deg"),
        ("mass_kg", "1e400", "too large"),
        ("stiffness_n_per_m", "1,200 N/m", "may be 1200 or 1.200"),
        ("heat_capacity_ratio", "1.4 J", "a plain number"),
    ],
)
def test_nonsense_is_refused_with_what_would_do(name, text, words):
    with pytest.raises(DatasheetError, match=words):
        read_quantity(name, text, AIR)


def test_angle_and_diameter_give_the_braid_of_the_paper():
    paper = MuscleParameters()
    angle_deg = math.degrees(math.acos(paper.rest_length_m / paper.braid_length_m))
    known = {"rest_length_m": paper.rest_length_m}
    known["braid_length_m"] = read_quantity("braid_length_m", f"{angle_deg!r} deg", known)
    assert known["braid_length_m"] == pytest.approx(paper.braid_length_m)
    # n pi D = b sin(theta)
    diameter_mm = 1e3 * paper.braid_length_m * math.sin(math.radians(angle_deg))
    diameter_mm /= math.pi * paper.braid_turns
    turns = read_quantity("braid_turns", f"{diameter_mm!r} mm diameter", known)
    assert turns == pytest.approx(paper.braid_turns)


def test_a_nominal_flow_is_that_of_an_isentropic_orifice():
    gain = read_quantity("valve_gain_m2_per_v", "350 l/min", AIR)
    # Psi from 7 to 6 bar by its closed form, at the 20 degC of the datasheet.
    ratio, gamma, upstream_pa, energy = 6.0 / 7.0, 1.4, 7e5, 287.1 * 293.15
    flow = upstream_pa * math.sqrt(
        2.0 * gamma / (gamma - 1.0) / energy
        * (ratio ** (2.0 / gamma) - ratio ** ((gamma + 1.0) / gamma))
    )  # fmt: skip
    assert 5.0 * gain * flow == pytest.approx(350e-3 / 60.0 * 1.185, rel=1e-9)


def test_every_number_of_the_settings_is_in_the_list_of_a_muscle_with_its_description():
    asked = {question.name: question.meaning for question in list_questions("muscle")}
    shares = {"return_friction.share", "braid_drag.share"}
    effects = {"external_load.force_n", "coulomb_friction.force_n", *shares}
    assert {*asked} == {*MuscleParameters.model_fields, *effects, "stroke_m"}
    assert all(asked.values())
    of_axis = {question.name for question in list_questions("direct")}
    assert {"mass_kg", "stiffness_n_per_m"} <= of_axis
    assert not of_axis & {"rest_length_m", "tank_pressure_pa", "valve_gain_m2_per_v"}


def test_the_file_says_what_each_number_means_and_how_it_was_given(tmp_path):
    out = tmp_path / "chamber.yaml"
    given = ["chamber_volume_m3=2 l", "atmospheric_pressure_pa=94 kPa"]
    given += ["tank_pressure_pa=6 bar gauge", "temperature_k=25 C"]
    values = [word for text in given for word in ("--value", text)]
    done = make("--out", str(out), "--actuator", "chamber", *values)
    assert done.exit_code == 0, done.stderr
    assert "will fit valve_gain_m2_per_v, tank_pressure_pa" in done.stdout
    assert read_section_file("plant", out) == PlantSettings(
        actuator="chamber",
        chamber_volume_m3=2e-3,
        parameters={
            "atmospheric_pressure_pa": 94e3,
            "tank_pressure_pa": 694e3,
            "temperature_k": 298.15,
        },
    )
    text = out.read_text()
    assert "# pressure of the supply, absolute; given as 6 bar gauge" in text
    assert "# opening of the valve per volt of command, K_Av\n" in text


@pytest.mark.parametrize(
    ("value", "code", "words"),
    [
        ("chamber_volume_m3=2 kg", 2, "is unclear; give m3, l"),
        ("chamber_volume_m3=-1 l", 78, "chamber_volume_m3: must be at least 1e-12 (got -0.001)"),
    ],
)
def test_a_number_that_cannot_be_is_refused_and_nothing_is_written(value, code, words, tmp_path):
    out = tmp_path / "no.yaml"
    done = make("--out", str(out), "--actuator", "chamber", "--value", value)
    assert (done.exit_code, out.exists()) == (code, False)
    assert words in done.stderr


def test_the_air_of_a_rig_of_ones_own_is_at_room_temperature_and_the_papers_is_not(tmp_path):
    new = tmp_path / "new.yaml"
    for actuator, values in (("chamber", ["--value", "chamber_volume_m3=2 l"]), ("muscle", [])):
        new.unlink(missing_ok=True)
        done = make("--out", str(new), "--actuator", actuator, *values)
        assert done.exit_code == 0, done.stderr
        assert read_section_file("plant", new).parameters.temperature_k == 293.0
    written = tmp_path / "written.yaml"
    for text, kelvin in (
        ("actuator: chamber\nchamber_volume_m3: 0.002\n", 293.0),
        ("actuator: chamber\nchamber_volume_m3: 0.002\nparameters: {temperature_k: 273}\n", 273.0),
        ("parameters: {mass_kg: 0.1}\n", 273.0),
    ):
        written.write_text(text)
        assert read_section_file("plant", written).parameters.temperature_k == kelvin
    assert resolve(plant="paper").plant.parameters.temperature_k == 273.0


def test_numbers_without_a_default_must_be_given(tmp_path):
    out = str(tmp_path / "axis.yaml")
    values = ["--value", "mass_kg=95 kg", "--value", "damping_n_s_per_m=200 N s/m"]
    lacking = make("--out", out, "--actuator", "direct", *values)
    assert (lacking.exit_code, Path(out).exists()) == (2, False)
    assert "stiffness_n_per_m" in lacking.stderr
    assert "has no default" in lacking.stderr
    nothing = make("--out", out, "--actuator", "cylinder")
    assert nothing.stderr.count("has no default") == 6  # all at once
    done = make("--out", out, "--actuator", "direct", *values,
                "--value", "stiffness_n_per_m=1")  # fmt: skip
    assert done.exit_code == 0, done.stderr
    assert read_section_file("plant", Path(out)).parameters.mass_kg == 95.0
    told = make("--out", str(tmp_path / "told.yaml"), "--json", "--actuator", "direct",
                *values, "--value", "stiffness_n_per_m=0")  # fmt: skip
    assert json.loads(told.stdout)["fitted"] == [
        "mass_kg", "damping_n_s_per_m", "external_load.force_n"
    ]  # fmt: skip
    again = make("--out", out, "--actuator", "muscle")
    assert "never overwritten" in again.stderr
    assert "such as " in again.stderr
    assert "-2.yaml" in again.stderr


def test_numbers_that_do_not_fit_together_or_are_not_there_write_nothing(tmp_path):
    out = tmp_path / "no.yaml"
    for options, code, words in (
        (["--value", "braid_length_m=0.1"], 78, "must lie between"),
        (["--value", "braid_lenght_m=0.1"], 2, "did you mean braid_length_m?"),
        (["--actuator", "pump"], 2, "is not one of muscle, direct, chamber"),
    ):
        done = make("--out", str(out), "--actuator", "muscle", *options)
        assert (done.exit_code, out.exists()) == (code, False), done.stderr
        assert words in done.stderr


def test_numbers_are_guessed_from_measured_text_and_say_so(tmp_path):
    t_s = np.arange(0.0, 6.0, 2e-3)
    motion = 0.02 * np.sin(9.0 * t_s) + 0.01 * np.sin(23.0 * t_s)
    speed = 0.18 * np.cos(9.0 * t_s) + 0.23 * np.cos(23.0 * t_s)
    push = -1.62 * np.sin(9.0 * t_s) - 5.29 * np.sin(23.0 * t_s)
    force = 3.0 * push + 40.0 * speed + 500.0 * motion
    table = np.column_stack([1e3 * t_s, force, 1e3 * motion])
    source, out = tmp_path / "axis.csv", tmp_path / "axis.yaml"
    np.savetxt(source, table, "%.6f", ",", header="time_ms,force_N,position_mm", comments="")
    done = make("--from", str(source), "--out", str(out), "--json")
    document = json.loads(done.stdout)
    assert document["actuator"] == "direct"
    for name, true in (("mass_kg", 3.0), ("damping_n_s_per_m", 40.0), ("stiffness_n_per_m", 500.0)):
        assert document["guessed"][name]["value"] == pytest.approx(true, rel=0.1)
    assert "guessed, from the balance of forces" in out.read_text()


def test_an_axis_whose_record_holds_no_force_is_told_so_and_how_to_give_its_current(tmp_path):
    source = tmp_path / "axis.csv"
    rows = "".join(f"{k},{np.sin(0.1 * k):.4f},{np.cos(0.1 * k):.4f}\n" for k in range(400))
    source.write_text("time [ms],I_ist [A],position [mm]\n" + rows)
    given = ("--value", "mass_kg=8.3", "--value", "stiffness_n_per_m=2500")
    done = make("--from", str(source), "--actuator", "direct", *given, "--out", str(tmp_path / "x"))
    assert done.exit_code == 2
    said = " ".join(done.stderr.split())
    assert "no guess: axis: the plant file has `actuator: direct`, which force_n must drive" in said
    assert "such as a drive's current with `unit: N` and its N/A for `gain`" in said
    assert said.index("no guess") < said.index("damping_n_s_per_m")


def test_a_file_whose_columns_are_not_clear_is_refused_with_the_way_to_a_map(tmp_path):
    source = tmp_path / "odd.csv"
    rows = "".join(f"{k},{k % 7},{k % 5}\n" for k in range(200))
    source.write_text("time_ms,Force thing,Way\n" + rows)
    done = make("--from", str(source), "--out", str(tmp_path / "odd.yaml"))
    assert done.exit_code == 65
    assert str(source) in done.stderr
    assert "--map MAP.yaml" in done.stderr


def test_a_number_of_any_effect_may_be_among_the_values(tmp_path):
    out = tmp_path / "muscle.yaml"
    given = ["external_load.force_n=5", "cubic_stiffness.n_per_m3=9", "dead_volume.volume_m3=9 cm3"]
    done = make(*(word for one in given for word in ("--value", one)), "--out", str(out))
    assert done.exit_code == 0, done.stderr
    assert "dead volume" in out.read_text()
    effects = read_section_file("plant", out).effects
    assert effects.cubic_stiffness == {"n_per_m3": 9.0}
    assert effects.dead_volume == {"volume_m3": pytest.approx(9e-6)}
    refused = make("--value", "dead_volume.size=9", "--out", str(tmp_path / "no.yaml"))
    assert refused.exit_code == 2
    assert "the numbers of dead_volume are volume_m3" in " ".join(refused.stderr.split())
