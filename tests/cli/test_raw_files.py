"""A laboratory's own files, whose headers say nothing: a map, a plant file, a diagnosis."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.command_line import run_pamctl

from pamctl.base.errors import ExitCode
from pamctl.cli.diagnose import REFUSED_FILES
from pamctl.diagnose import Diagnosis, Verdict
from pamctl.diagnose.read_record import record_of
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page
from pamctl.plant.model import PlantSettings
from pamctl.report.html_page import write_html
from pamctl.settings.resolve import read_section_file

MASS_KG, DAMPING, STIFFNESS = 2.0, 35.0, 900.0
MAP = """\
time: {column: Zeit_ms, unit: ms}
force: {column: S1, unit: N}
position: {column: A, unit: mm}
"""


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a table of a mass on a spring, by another solver, with decimal commas."""
    t_s = np.arange(2000) / 250.0
    force_n = sum(8.0 * np.sin(2.0 * np.pi * hz * t_s) for hz in (0.4, 1.1, 2.3, 4.9))

    def rates(at_s: float, xv: np.ndarray) -> list[float]:
        push_n = np.interp(at_s, t_s, force_n)
        return [xv[1], (push_n - DAMPING * xv[1] - STIFFNESS * xv[0]) / MASS_KG]

    position_m = solve_ivp(rates, (0.0, t_s[-1]), [0.0, 0.0], t_eval=t_s, rtol=1e-8, atol=1e-11).y[
        0
    ]
    position_m += np.random.default_rng(1).normal(0.0, 2e-6, len(t_s))
    rows = zip(t_s * 1e3, force_n, position_m * 1e3, strict=True)
    lines = [f"{at:.0f};{n:.4f};{mm:.5f}".replace(".", ",") for at, n, mm in rows]
    path = tmp_path_factory.mktemp("lab") / "run 1.csv"
    path.write_text("\n".join(["Zeit_ms;S1;A", *lines]) + "\n")
    path.with_name("map.yaml").write_text(MAP)
    return path


def write_muscle(table: Path) -> Path:
    """Write a table with the columns of a muscle, or a cylinder."""
    t_s = np.arange(600) / 100.0
    fill = np.sin(t_s)
    rows = zip(t_s, fill, 200.0 + 50.0 * fill, 20.0 + 9.0 * fill, strict=True)
    lines = [",".join(f"{cell:.4f}" for cell in row) for row in rows]
    table.write_text("\n".join(["t_s,valve_V,pressure_kPa,position_mm", *lines]) + "\n")
    return table


def test_a_plant_file_says_at_once_that_it_is_not_one_of_the_log_it_is_made_from(tmp_path):
    made = ["plant", "new", "--from", write_muscle(tmp_path / "rig.csv"), "--actuator", "chamber"]
    said = run_pamctl(*made, "--value", "chamber_volume_m3=1 l", "--out", tmp_path / "rig.yaml")
    assert said.returncode == 0, said.stderr
    assert "warning: rig: position_m moves by 18 mm" in said.stderr


def test_what_is_the_same_of_several_files_is_said_once_with_their_names(tmp_path):
    files = [write_muscle(tmp_path / f"{name}.csv") for name in "abc"]
    made = ["plant", "new", "--actuator", "muscle", "--from", files[0]]
    made += [word for file in files[1:] for word in ("--from", file)]
    said = run_pamctl(*made, "--out", tmp_path / "rig.yaml").stderr
    assert said.count("imported: t_s as t_s") == 1
    assert "a, b, c: imported: t_s as t_s" in said


def test_a_muscle_and_a_cylinder_have_the_same_columns_so_one_is_asked_for(tmp_path):
    table, out = write_muscle(tmp_path / "rig.csv"), tmp_path / "rig.yaml"
    asked = run_pamctl("plant", "new", "--from", table, "--out", out)
    assert asked.returncode == 2
    assert "--actuator muscle or --actuator cylinder" in asked.stderr
    assert not out.exists()
    made = ["plant", "new", "--actuator", "muscle", "--from", table]
    said = run_pamctl(*made, "--out", out)
    assert said.returncode == 0, said.stderr
    papers = "of the paper's muscle, as none was given: "
    assert f"{papers}rest_length_m, braid_length_m, braid_turns" in said.stdout
    assert out.read_text().count("; of the paper's muscle") == 3
    given = run_pamctl(
        *made, "--value", "rest_length_m=210 mm", "--out", out.with_name("other.yaml")
    )
    assert f"{papers}braid_length_m, braid_turns;" in given.stdout
    plant = read_section_file("plant", out.with_name("other.yaml")).parameters
    assert plant.braid_length_m / plant.rest_length_m == pytest.approx(0.232 / 0.2)


def test_a_length_of_a_muscle_is_no_contraction_and_a_new_plant_says_so_at_once(tmp_path):
    table, column_map = write_muscle(tmp_path / "rig.csv"), tmp_path / "map.yaml"
    column_map.write_text(
        "time: {column: t_s, unit: s}\nvalve: {column: valve_V, unit: V}\n"
        "pressure: {column: pressure_kPa, unit: kPa, gauge: false}\n"
        "position: {column: position_mm, unit: mm, gain: -1, offset: 200}\n"
    )
    made = ["plant", "new", "--actuator", "muscle", "--from", table, "--map", column_map]
    said = run_pamctl(*made, "--out", tmp_path / "rig.yaml").stderr
    assert "the length of the muscle, which is 0.2 m at rest" in said
    assert "contraction = offset - length" in said


def test_with_a_map_they_make_a_plant_file_and_a_diagnosis(table):
    column_map, plant = table.with_name("map.yaml"), table.with_name("rig.yaml")
    made = run_pamctl("plant", "new", "--from", table, "--map", column_map, "--out", plant)
    assert made.returncode == 0, made.stderr
    assert f"next: pamctl diagnose '{table}' --map {column_map} --plant {plant}" in made.stdout
    assert "write 0 if there is no spring" not in made.stdout.split("stiffness")[0]
    assert "write 0 if there is no spring" in made.stdout
    assert "write 0 if there is no spring" in plant.read_text()
    out = table.with_name("found")
    done = run_pamctl("diagnose", table, "--map", column_map, "--plant", plant, "--out", out)
    assert done.returncode == 0, done.stderr
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["verdict"] in ("no_discrepancy", "miscalibrated")
    mass = found["recalibrated"]["mass_kg"]
    assert mass["value"] == pytest.approx(MASS_KG, rel=0.005)


def test_compare_takes_a_measured_file_and_its_map_as_diagnose_does(table, tmp_path):
    plant, page = tmp_path / "axis.yaml", tmp_path / "page.html"
    column_map = table.with_name("map.yaml")
    made = ["plant", "new", "--from", table, "--map", column_map, "--out", plant]
    assert run_pamctl(*made).returncode == 0
    refused = run_pamctl("compare", table, "--plant", plant)
    assert refused.returncode == 65
    assert "add --map MAP.yaml" in refused.stderr
    words = ["compare", table, "--map", column_map, "--plant", plant, "--plot", page]
    done = run_pamctl(*words)
    assert done.returncode == 0, done.stderr
    assert "run 1: imported: Zeit_ms as t_s, ms" in done.stderr
    assert f"next: pamctl diagnose '{table}' --map {column_map} --plant {plant}" in done.stdout
    assert "<svg" in page.read_text()
    log = tmp_path / "run 1.mcap"
    assert run_pamctl("log", "import", table, log, "--map", column_map).returncode == 0
    gaps = [line for line in done.stdout.splitlines() if "mechanics" in line]
    same = run_pamctl("compare", log, "--plant", plant).stdout.splitlines()
    assert [line for line in same if "mechanics" in line] == gaps != []


def test_what_an_import_warned_of_goes_on_to_the_diagnosis(tmp_path):
    table, log = write_muscle(tmp_path / "rig.csv"), tmp_path / "rig.mcap"
    (tmp_path / "map.yaml").write_text(
        "time: {column: t_s}\nvalve: {column: valve_V}\n"
        "pressure: {column: pressure_kPa, unit: kPa, gauge: false}\n"
        "position: {column: position_mm, unit: cm}\n"
    )
    done = run_pamctl("log", "import", table, log, "--map", tmp_path / "map.yaml")
    assert done.returncode == 0, done.stderr
    record = record_of(log)
    told = "'position_mm' says mm, and the map cm: the map is followed"
    assert told in record.notes
    found = Diagnosis(Verdict.BAD_DATA, PlantSettings(), PlantSettings(), "x", train=(record,))
    assert f"rig: {told}" in build_diagnosis_document(found)["notes"]
    assert "says mm, and the map cm" in write_html(build_diagnosis_page(found, [record]))


def test_a_map_that_fits_one_file_of_a_call_names_the_way_for_the_others(table, tmp_path):
    other = tmp_path / "other.csv"
    other.write_text(table.read_text().replace("Zeit_ms", "Time"))
    map_path = table.with_name("map.yaml")
    made = ["plant", "new", "--actuator", "direct", "--map", map_path]
    done = run_pamctl(*made, "--from", table, "--from", other, "--out", tmp_path / "a.yaml")
    assert done.returncode == 65
    assert "there is no column 'Zeit_ms'" in done.stderr
    assert "--map is for all files of the call" in done.stderr
    assert "pamctl log import" in done.stderr


def test_a_refused_diagnosis_may_be_typed_again_and_no_other_folder_is_written_into(tmp_path):
    table, out = write_muscle(tmp_path / "rig.csv"), tmp_path / "found"
    plant = tmp_path / "chamber.yaml"
    plant.write_text("actuator: chamber\nchamber_volume_m3: 1e-3\n")
    asked = ["diagnose", table, "--plant", plant, "--out", out]
    for _ in range(2):
        assert run_pamctl(*asked).returncode == ExitCode.BAD_DATA
    assert {path.name for path in out.iterdir()} == REFUSED_FILES
    (out / "mine.txt").write_text("mine")
    assert "it exists and is not an empty folder" in run_pamctl(*asked).stderr
    (out / "mine.txt").unlink()
    document = out / "diagnosis.json"
    document.write_text(document.read_text().replace("bad_data", "named"))
    assert "it exists and is not an empty folder" in run_pamctl(*asked).stderr
