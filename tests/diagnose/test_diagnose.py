"""From records to a finding: its verdict and gap, and what an interrupt leaves of it."""

import json
import signal
import sys
from collections.abc import Collection
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.command_line import start_process
from support.made_records import ask_only, measured, names_of, pair

from pamctl.base.errors import ExitCode
from pamctl.diagnose import Diagnosis, DiagnosisInterrupted, Record, Verdict, diagnose, sentence
from pamctl.diagnose.audit import audit_run
from pamctl.diagnose.evidence import forecast
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page, format_plant_file
from pamctl.diagnose.report.verdict_phrases import list_shifts
from pamctl.plant.model import PlantSettings
from pamctl.report.html_page import write_html
from pamctl.settings.resolve import SECTIONS, RawSettings, validate_settings

PAPER = PlantSettings()


@cache
def diagnosed(**hidden: float) -> Diagnosis:
    return diagnose(*pair(**hidden), PAPER)


@cache
def of_a_dead_band() -> Diagnosis:
    return diagnosed(valve_deadband__fill_width_v=0.25, valve_deadband__exhaust_width_v=0.2)


def test_nothing_is_missing_from_the_model_that_made_the_records():
    found = diagnosed()
    assert found.verdict is Verdict.NO_DISCREPANCY
    assert build_diagnosis_document(found)["findings"] == []
    assert found.plant == PAPER


def test_wrong_numbers_are_found_and_named_as_no_effect():
    off = {"stiffness_n_per_m": 9200.0, "valve_gain_m2_per_v": 1.1e-6, "damping_n_s_per_m": 600.0}
    asked = ask_only("valve", "creep", "stiffness~", "damping~")
    found = diagnose(*pair(**off), PAPER, without=asked)
    assert found.verdict is Verdict.MISCALIBRATED
    for name, value in off.items():
        assert build_diagnosis_document(found)["recalibrated"][name]["value"] == pytest.approx(
            value, rel=5e-3
        )
    assert "stiffness_n_per_m -5.0 %" in sentence(found)


def test_a_hidden_dead_band_is_named_and_measured_on_both_sides():
    found = of_a_dead_band()
    assert found.verdict is Verdict.NAMED
    (effect,) = build_diagnosis_document(found)["effects"]
    assert effect["name"] == "valve_deadband"
    assert effect["parameters"]["fill_width_v"]["value"] == pytest.approx(0.25, rel=0.02)
    assert effect["parameters"]["exhaust_width_v"]["value"] == pytest.approx(0.20, rel=0.02)
    assert all(rival["is_beaten"] or rival["is_freer"] for rival in effect["rivals"])
    assert effect["confidence"] > 0.99


def test_the_forecast_of_the_time_is_right_within_a_factor_of_two():
    for found, findings in ((diagnosed(), 0), (of_a_dead_band(), 1)):
        assert found.evidence is not None
        foretold = forecast.ASKED * len(found.evidence.pool) + forecast.FITTED * findings
        assert 0.5 * foretold < found.evidence.weigher.simulations < 2.0 * foretold


def test_the_gap_of_the_coupled_model_shrinks_to_the_sensor_noise():
    gap = of_a_dead_band().gap
    for column in ("position_m", "pressure_pa"):
        within = 1.2 if column == "pressure_pa" else 1.5  # a position below half a count
        assert gap[column].extended < within * gap[column].floor
        assert gap[column].recalibrated > 10.0 * gap[column].floor


def test_the_plant_file_holds_the_effect_and_can_be_read(tmp_path):
    found = of_a_dead_band()
    path = tmp_path / "plant.yaml"
    path.write_text(format_plant_file(found, ["a.mcap"]))
    again = validate_settings(SECTIONS["plant"], RawSettings.read(path), title="plant")
    assert again == found.plant
    assert again.effects.valve_deadband["fill_width_v"] == pytest.approx(0.25, rel=0.02)


def test_a_next_diagnosis_from_the_extended_plant_finds_nothing_more():
    hidden = {"valve_deadband__fill_width_v": 0.25, "valve_deadband__exhaust_width_v": 0.2}
    asked = ask_only("valve", "opening~", "filling~", "exhausting~", "leak")
    again = diagnose(*pair(**hidden), of_a_dead_band().plant, without=asked)
    assert again.verdict in (Verdict.NO_DISCREPANCY, Verdict.MISCALIBRATED)


@pytest.mark.long
def test_a_sensor_offset_is_not_named_a_bladder_threshold():
    asked = ask_only("pressure_sensor", "bladder", "load", "pull~", "opening~")
    hidden = pair(pressure_sensor_offset__offset_pa=4000.0)
    found = diagnose(*hidden, PAPER, without=asked)
    assert names_of(found) == ["pressure_sensor_offset"]
    assert found.verdict is Verdict.NAMED


def test_pressure_and_position_are_enough_to_diagnose_the_mechanics():
    train, held = pair(cubic_stiffness__n_per_m3=2e6)
    parts = ([replace(r, valve_v=None) for r in part] for part in (train, held))
    found = diagnose(*parts, PAPER, without=ask_only("stiffness", "creep", "force~", "braid"))
    assert names_of(found) == ["cubic_stiffness"]
    assert set(build_diagnosis_document(found)["gap"]) == {"position_m"}


def test_the_document_is_json_with_every_key_of_the_schema():
    for found in (diagnosed(), of_a_dead_band()):
        written = json.loads(json.dumps(build_diagnosis_document(found), allow_nan=False))
        assert written["schema"] == 2
        assert {
            "verdict", "sentence", "setup", "effects", "terms", "places", "ambiguous", "findings",
            "recalibrated", "at_bound", "gap", "explained", "unexplained", "confirmed_on", "masked",
            "blind_spots", "next_experiment", "forecasts", "accepted", "noise",
        } <= written.keys()  # fmt: skip
        assert {"nominal", "recalibrated", "extended", "floor"} == written["gap"][
            "pressure_pa"
        ].keys()


def test_the_moving_mass_is_reported_as_unidentifiable():
    spots = {spot.name: spot for spot in audit_run(measured("fit"), PAPER).blind_spots}
    assert spots["moving_mass"].experiment == ""


# --- a start model that has effects ------------------------------------------------------


def test_the_effects_of_the_start_model_are_recalibrated_with_its_numbers():
    start = PlantSettings.model_validate(
        {"effects": {"cubic_stiffness": {"n_per_m3": 1.5e6}, "creep": {"stiffness_n_per_m": 200}}}
    )
    hidden = {"cubic_stiffness__n_per_m3": 2e6, "creep__stiffness_n_per_m": 260.0}
    train, held = pair(**hidden)
    found = diagnose(
        *[[replace(r, valve_v=None) for r in part] for part in (train, held)],
        start,
        without=ask_only("external_load"),
    )
    assert not found.findings
    numbers = build_diagnosis_document(found)["recalibrated"]
    assert numbers["cubic_stiffness.n_per_m3"]["value"] == pytest.approx(2e6, rel=0.05)
    assert numbers["creep.stiffness_n_per_m"]["value"] == pytest.approx(260.0, rel=0.05)
    assert "creep.fast_share" not in numbers
    assert "cubic_stiffness.n_per_m3 +3" in list_shifts(found)
    assert found.plant.effects.creep["stiffness_n_per_m"] == pytest.approx(260.0, rel=0.05)


def test_a_model_that_runs_away_from_all_that_was_measured_is_refused():
    train, held_out = pair()
    pulled = PlantSettings.model_validate(
        {"parameters": {"stiffness_n_per_m": 1e-15}, "effects": {"external_load": {"force_n": 200}}}
    )
    found = diagnose(train, held_out, pulled)
    assert found.verdict is Verdict.BAD_DATA
    assert "runs away" in found.reason


# --- interrupts ----------------------------------------------------------------------------------

ASKED = ("valve_deadband", "chamber_leak", "opening~", "flow~")


def measure() -> Record:
    return measured("fit", valve_deadband__fill_width_v=0.3, chamber_leak__area_m2=2e-8)


def interrupt_at(words: str, times: int, record: Record, asked: Collection[str] = ASKED) -> None:
    """Diagnose a record, with an interrupt where progress says these words."""
    heard = 0

    def hear(line: str) -> None:
        nonlocal heard
        heard += words in line
        if heard == times:
            heard = 100
            raise KeyboardInterrupt

    diagnose([record], [], PlantSettings(), without=ask_only(*asked), progress=hear)
    raise AssertionError("it ended before the interrupt")


def test_the_first_finding_is_kept_and_is_not_called_sure():
    with pytest.raises(DiagnosisInterrupted) as stopped:
        interrupt_at("explanations asked", 2, measure())
    found = stopped.value.diagnosis
    assert found.verdict is Verdict.INTERRUPTED
    (first,) = found.findings
    assert first.level == "unjudged"
    assert names_of(found) == []
    assert {*found.plant.acting} == {first.name}
    document = build_diagnosis_document(found)
    assert document["effects"] == document["terms"] == document["ambiguous"] == []
    html = write_html(build_diagnosis_page(found, [*found.train]))
    assert "Interrupted; found until then" in html


def test_before_the_first_finding_the_recalibrated_model_is_kept():
    with pytest.raises(DiagnosisInterrupted) as stopped:
        interrupt_at("explanations asked", 1, measure())
    found = stopped.value.diagnosis
    assert (found.verdict, found.findings) == (Verdict.INTERRUPTED, ())
    assert found.recalibrated


def test_an_interrupt_after_the_verdict_loses_the_next_program_alone():
    strokes = measured("squares", null_offset__offset_v=0.1)
    alike = ("null_offset", "valve_asymmetry", "valve_deadband")
    with pytest.raises(DiagnosisInterrupted) as stopped:
        interrupt_at("choosing the program", 1, strokes, alike)
    assert stopped.value.diagnosis.verdict is not Verdict.INTERRUPTED


def test_a_signal_writes_the_folder_and_says_so(tmp_path):
    record = measure()
    rows = np.stack([record.t_s, record.valve_v, record.pressure_pa, record.position_m], axis=1)
    csv, out = tmp_path / "run.csv", tmp_path / "out"
    np.savetxt(csv, rows, delimiter=",", header="t_s,valve_v,pressure_pa,position_m", comments="")
    command = [sys.executable, "-m", "pamctl", "diagnose", str(csv), "--out", str(out)]
    verb = start_process(command)
    assert verb.stderr is not None
    said = ""
    while "recalibrated" not in said:
        said = verb.stderr.readline()
        assert said, "the verb ended"
    verb.send_signal(signal.SIGINT)
    printed, told = verb.communicate(timeout=120)
    assert verb.returncode == ExitCode.SIGINT
    assert "interrupted: writing what was found so far" in told
    assert "Traceback" not in told
    assert printed.startswith("interrupted: Interrupted; found until then")
    assert json.loads((out / "diagnosis.json").read_text())["verdict"] == "interrupted"
    assert {f.name for f in out.iterdir()} == {"diagnosis.json", "plant.yaml", "report.html"}
