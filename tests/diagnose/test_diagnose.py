"""The diagnosis on records in which something is hidden: it says what, or that it cannot."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.made_records import COUNT_M, PERIOD_S, all_but, measured, pair

from pamctl.diagnose import Diagnosis, Record, Verdict, diagnose, sentence
from pamctl.diagnose.audit import audit_run
from pamctl.diagnose.fitting.block_fit import fit_numbers, rms
from pamctl.diagnose.fitting.candidates import Candidate, list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, RUNAWAY, stack_residuals
from pamctl.diagnose.fitting.evidence import Evidence, prepare_evidence, with_modelled_pressure
from pamctl.diagnose.fitting.model_fit import fit_jointly, fit_model, recalibrate, weigh_blocks
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.diagnose.measured.column_shift import check_time_shifts
from pamctl.diagnose.measured.record import estimate_resolution
from pamctl.diagnose.measured.sensor_noise import estimate_channel_noise
from pamctl.diagnose.naming import rivals
from pamctl.diagnose.naming.score import score_candidates
from pamctl.diagnose.naming.search import search_effects
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.extended_plant_file import format_plant_file
from pamctl.plant.model import PlantSettings
from pamctl.settings.resolve import SECTIONS, RawSettings, validate_settings

PAPER = PlantSettings()


@cache
def diagnosed(**hidden: float) -> Diagnosis:
    return diagnose(*pair(**hidden), PAPER)


@cache
def of_a_dead_band() -> Diagnosis:
    return diagnosed(valve_deadband__fill_width_v=0.25, valve_deadband__exhaust_width_v=0.2)


def test_of_the_model_itself_it_says_that_nothing_is_missing() -> None:
    found = diagnosed()
    assert found.verdict is Verdict.NO_DISCREPANCY
    assert found.plant == PAPER
    assert build_diagnosis_document(found)["effects"] == []


def test_numbers_that_are_off_are_found_and_no_effect_is_made_of_them() -> None:
    off = {"stiffness_n_per_m": 9200.0, "valve_gain_m2_per_v": 1.1e-6, "damping_n_s_per_m": 600.0}
    found = diagnosed(**off)
    assert found.verdict is Verdict.MISCALIBRATED
    for name, value in off.items():
        assert build_diagnosis_document(found)["recalibrated"][name]["value"] == pytest.approx(
            value, rel=5e-3
        )
    assert "stiffness_n_per_m -5.0 %" in sentence(found)


def test_a_hidden_dead_band_is_named_and_measured_on_both_sides() -> None:
    found = of_a_dead_band()
    assert found.verdict is Verdict.NAMED
    (effect,) = build_diagnosis_document(found)["effects"]
    assert effect["name"] == "valve_deadband"
    assert effect["parameters"]["fill_width_v"]["value"] == pytest.approx(0.25, rel=0.02)
    assert effect["parameters"]["exhaust_width_v"]["value"] == pytest.approx(0.20, rel=0.02)
    assert all(rival["residual_over_floor"] > 2.0 for rival in effect["rivals"])


def test_the_gap_of_the_coupled_model_shrinks_to_the_sensors_noise() -> None:
    gap = of_a_dead_band().gap
    assert gap is not None
    for signal in ("position_m", "pressure_pa"):
        within = 1.2 if signal == "pressure_pa" else 1.5  # a position below half a count
        assert gap[signal].extended < within * gap[signal].floor
        assert gap[signal].recalibrated > 10.0 * gap[signal].floor


def test_the_plant_file_holds_the_effect_and_is_read_again(tmp_path) -> None:
    found = of_a_dead_band()
    path = tmp_path / "plant.yaml"
    path.write_text(format_plant_file(found, ["a.mcap"]))
    again = validate_settings(SECTIONS["plant"], RawSettings.read(path), title="plant")
    assert again == found.plant
    assert again.effects.valve_deadband.fill_width_v == pytest.approx(0.25, rel=0.02)


def test_a_next_diagnosis_from_the_extended_plant_finds_nothing_more() -> None:
    hidden = {"valve_deadband__fill_width_v": 0.25, "valve_deadband__exhaust_width_v": 0.2}
    again = diagnose(*pair(**hidden), of_a_dead_band().plant)
    assert again.verdict in (Verdict.NO_DISCREPANCY, Verdict.MISCALIBRATED)


def test_an_offset_of_the_sensor_is_no_threshold_of_the_bladder() -> None:
    found = diagnosed(pressure_sensor_offset__offset_pa=4000.0)
    assert [s.effect.name for s in found.standings] == ["pressure_sensor_offset"]
    assert found.verdict is Verdict.NAMED


def test_without_its_name_in_the_catalogue_no_other_effect_is_blamed() -> None:
    hidden = {"valve_deadband__fill_width_v": 0.25, "valve_deadband__exhaust_width_v": 0.2}
    found = diagnose(*pair(**hidden), PAPER, without=all_but("valve_curve", "valve_leak", "creep"))
    assert found.verdict is Verdict.NONE_KNOWN
    assert (
        build_diagnosis_document(found)["correction"]["label"] == "unnamed correction, not a cause"
    )


def test_pressure_and_position_alone_serve_the_mechanics() -> None:
    train, held = pair(cubic_stiffness__n_per_m3=2e6)
    found = diagnose(*[[replace(r, valve_v=None) for r in part] for part in (train, held)], PAPER)
    assert [s.effect.name for s in found.standings] == ["cubic_stiffness"]
    assert set(build_diagnosis_document(found)["gap"]) == {"position_m"}


def test_candidates_fitted_by_workers_give_the_same_document() -> None:
    records = pair(valve_asymmetry__exhaust_gain=0.9)
    few = all_but("valve_asymmetry", "valve_leak")
    with ThreadPoolExecutor(2) as executor:
        by_workers = diagnose(*records, PAPER, without=few, executor=executor)
    assert build_diagnosis_document(by_workers) == build_diagnosis_document(
        diagnose(*records, PAPER, without=few)
    )
    assert [s.effect.name for s in by_workers.standings] == ["valve_asymmetry"]


def test_the_document_is_json_with_every_key_of_the_schema() -> None:
    for found in (diagnosed(), of_a_dead_band()):
        written = json.loads(json.dumps(build_diagnosis_document(found), allow_nan=False))
        assert written["schema"] == 1
        assert {
            "verdict",
            "effects",
            "ambiguous",
            "recalibrated",
            "blind_spots",
            "next_experiment",
            "gap",
            "unexplained",
        } <= written.keys()
        assert {"nominal", "recalibrated", "extended", "floor"} == written["gap"][
            "pressure_pa"
        ].keys()


def test_full_scale_squares_are_said_to_be_blind_to_a_dead_band() -> None:
    audit = audit_run(measured("squares"), PAPER)
    assert "valve_deadband" in {spot.name for spot in audit.blind_spots}
    assert "valve_deadband" in audit_run(measured("fit"), PAPER).sees


def test_the_moving_mass_is_reported_as_unidentifiable() -> None:
    spots = {spot.name: spot for spot in audit_run(measured("fit"), PAPER).blind_spots}
    assert spots["moving_mass"].experiment == ""


def test_a_rival_that_does_better_takes_the_place_of_what_it_is_held_against() -> None:
    train, held = pair(valve_spool__time_constant_s=5e-4)
    evidence = prepare_evidence(train, held, PAPER).select_blocks({PRESSURE})
    late, slow = candidate("command_delay", evidence), candidate("valve_spool", evidence)
    search = search_effects(recalibrate(evidence), [late])
    assert search.best.names == ("command_delay",)
    (standing,) = rivals.find_rivals(search.best, search, [late, slow])
    assert search.add_models(standing.rival_models).best.names == ("valve_spool",)


def test_a_rival_that_leaves_something_is_no_equal_of_what_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rivals, "MUCH", np.inf)  # were the comparison to say nothing at all
    train, held = pair(valve_spool__time_constant_s=5e-4)
    evidence = prepare_evidence(train, held, PAPER).select_blocks({PRESSURE})
    late, slow = candidate("command_delay", evidence), candidate("valve_spool", evidence)
    search = search_effects(recalibrate(evidence), [slow])
    (standing,) = rivals.find_rivals(search.best, search, [late, slow])
    (rival,) = standing.rivals
    assert rival.residual_over_floor > search.best.floors[PRESSURE].limit
    assert standing.equal_rivals == ()


def test_a_fit_of_the_mechanics_ends_where_no_number_would_improve_it() -> None:
    """Braid, stiffness and friction make a narrow valley: a coarse slope stops on its side."""
    off = {"damping_n_s_per_m": 620.0, "stiffness_n_per_m": 9300.0, "braid_length_m": 0.2316}
    hidden = {**off, "kinetic_friction_per_m": 60.0}
    evidence = prepare_evidence(*pair(**hidden), PAPER).select_blocks({MECHANICS})
    fitted = recalibrate(evidence).fit_of(MECHANICS)
    directions = np.linalg.qr(fitted.jacobian)[0]
    could_go = np.linalg.norm(directions.T @ fitted.residual) / np.linalg.norm(fitted.residual)
    assert could_go < 0.01
    assert rms(fitted.residual) < rms(stack_residuals(fitted.drives, with_values(PAPER, hidden)))


def candidate(name: str, evidence: Evidence) -> Candidate:
    return next(c for c in list_candidates(evidence) if c.name == name)


def test_a_load_is_not_shared_out_to_the_zero_of_the_pressure_sensor() -> None:
    """The mechanics alone cannot tell them apart; the pressure block knows its zero."""
    base = weigh_blocks(recalibrate(prepare_evidence(*pair(external_load__force_n=1.3), PAPER)))
    load = candidate("external_load", base.evidence)
    start = {"external_load.force_n": 1.0}
    found = fit_jointly(fit_model(base, (load,), [start]))
    assert found.is_complete
    values = found.fit_of(MECHANICS).values
    assert values["external_load.force_n"] == pytest.approx(1.3, rel=0.05)
    assert abs(values["pressure_sensor_offset.offset_pa"]) < 50.0


def test_a_start_from_which_the_model_runs_away_is_drawn_back() -> None:
    """A spring as soft as that lets go of the muscle beyond 15 mm."""
    evidence = prepare_evidence(*pair(), PAPER).select_blocks({MECHANICS})
    cubic = candidate("cubic_stiffness", evidence)
    wild = with_values(PAPER, {"cubic_stiffness.n_per_m3": -1e7, "stiffness_n_per_m": 7000.0})
    drives = evidence.train[MECHANICS]
    assert np.max(np.abs(stack_residuals(drives, wild))) > 0.99 * RUNAWAY
    found = fit_numbers(drives, wild, (*recalibrate(evidence).fit_of(MECHANICS).free, *cubic.free))
    assert np.all(np.abs(found.residual) < 100.0)
    assert abs(found.values["cubic_stiffness.n_per_m3"]) < 3e4


def test_what_a_number_at_the_end_of_its_range_strains_for_may_be_an_effect_s() -> None:
    evidence = prepare_evidence(*pair(end_cap__length_m=4e-3), PAPER).select_blocks({PRESSURE})
    base = recalibrate(evidence).fit_of(PRESSURE)
    assert "braid_length_m" in base.at_bound
    (score,) = score_candidates(base, [candidate("end_cap", evidence)], PRESSURE)
    assert score.explained > 0.3


# --- what is refused -------------------------------------------------------------------


def spoilt(**changes: object) -> str:
    """Return why a record with these columns is refused."""
    record = replace(measured("fit", 1), **changes)  # type: ignore[arg-type]
    found = diagnose([record], [measured("judge", 2)], PAPER)
    assert found.verdict is Verdict.BAD_DATA
    assert build_diagnosis_document(found)["reason"] == found.reason
    return found.reason


def test_data_that_would_mislead_are_refused_with_the_reason() -> None:
    good = measured("fit", 1)
    pressure, position, command = good["pressure_pa"], good["position_m"], good["valve_v"]
    assert "kPa" in spoilt(pressure_pa=pressure * 1e-3)
    assert "gauge" in spoilt(pressure_pa=pressure - 101.3e3)
    assert "mm or counts" in spoilt(position_m=position * 1e3)
    assert "driver's offset" in spoilt(valve_v=command + 5.0)
    assert "clipped" in spoilt(pressure_pa=np.minimum(pressure, 350e3))
    t_s = good.t_s.copy()
    t_s[2000:] += 0.3
    assert "a gap of 0.301 s after row 1999" in spoilt(t_s=t_s)
    assert "pressure_pa answers 4" in spoilt(pressure_pa=np.roll(pressure, 40))
    assert "ms before valve_v" in spoilt(pressure_pa=np.roll(pressure, -20))
    assert "ms before pressure_pa" in spoilt(position_m=np.roll(position, -60))
    assert "ms after pressure_pa" in spoilt(
        position_m=np.concatenate([np.zeros(110), position[:-110]])
    )
    broken = position.copy()
    broken[77] = np.nan
    assert "row 77" in spoilt(position_m=broken)


def test_the_longest_lags_of_the_catalogue_are_no_shift_of_a_column() -> None:
    lags = {
        "command_delay__delay_s": 0.02,
        "valve_spool__time_constant_s": 0.005,
        "bladder_threshold__pressure_pa": 60e3,
        "coulomb_friction__force_n": 40.0,
        "damping_n_s_per_m": 1200.0,
    }
    for hidden in (lags, {"pressure_sensor_lag__time_constant_s": 0.02}, {}):
        assert [*check_time_shifts(measured("fit", **hidden))] == []


def test_a_channel_that_stands_still_is_refused() -> None:
    still = [replace(r, position_m=np.full(len(r), 1e-3)) for r in pair()[0]]
    assert "not excited" in diagnose(still, still, PAPER).reason


def test_columns_of_different_lengths_are_an_error_of_the_caller() -> None:
    with pytest.raises(ValueError, match="3 samples"):
        Record("short", np.arange(4) * PERIOD_S, valve_v=np.zeros(3))


# --- the sensors -----------------------------------------------------------------------


def test_noise_and_resolution_are_read_off_a_record() -> None:
    record = measured("fit", 5)
    assert estimate_resolution(record["position_m"]) == pytest.approx(3.175e-6)
    assert estimate_resolution(record["pressure_pa"]) == pytest.approx(47.5)
    assert estimate_channel_noise([record], "pressure_pa").deviation == pytest.approx(
        300.0, rel=0.05
    )


def test_noise_with_a_memory_is_drawn_with_that_memory() -> None:
    random = np.random.default_rng(3)
    coloured = np.convolve(random.normal(0.0, 300.0, 4010), np.ones(8) / np.sqrt(8.0))[8:4008]
    still = np.zeros(4000)
    record = Record(
        "rest", np.arange(4000) * PERIOD_S, valve_v=still - 5.0, pressure_pa=1.013e5 + coloured
    )
    drawn = estimate_channel_noise([record], "pressure_pa").draw(20_000, random)
    wanted, found = (np.corrcoef(v[1:], v[:-1])[0, 1] for v in (coloured, drawn))
    assert drawn.std() == pytest.approx(coloured.std(), rel=0.1)
    assert found == pytest.approx(wanted, abs=0.05)


# --- a start model that has effects ------------------------------------------------------


def test_the_effects_of_the_start_model_are_recalibrated_with_its_numbers() -> None:
    start = PlantSettings.model_validate(
        {"effects": {"cubic_stiffness": {"n_per_m3": 1.5e6}, "creep": {"stiffness_n_per_m": 200}}}
    )
    hidden = {"cubic_stiffness__n_per_m3": 2e6, "creep__stiffness_n_per_m": 260.0}
    train, held = pair(**hidden)
    found = diagnose(
        *[[replace(r, valve_v=None) for r in part] for part in (train, held)],
        start,
        without=all_but("external_load"),
    )
    assert found.verdict is Verdict.MISCALIBRATED
    numbers = build_diagnosis_document(found)["recalibrated"]
    assert numbers["cubic_stiffness.n_per_m3"]["value"] == pytest.approx(2e6, rel=0.05)
    assert numbers["creep.stiffness_n_per_m"]["value"] == pytest.approx(260.0, rel=0.05)
    assert "creep.fast_share" not in numbers
    assert "cubic_stiffness.n_per_m3 +3" in sentence(found)
    assert found.plant.effects.creep.stiffness_n_per_m == pytest.approx(260.0, rel=0.05)


def test_a_zero_that_homing_left_does_not_hide_the_sensors_offset() -> None:
    start = PlantSettings.model_validate(
        {"effects": {"pressure_sensor_offset": {"offset_pa": 12.0}}}
    )
    assert "pressure_sensor_offset" in {
        c.name for c in list_candidates(prepare_evidence(*pair(), start))
    }


def test_a_muscle_that_a_leak_held_up_as_the_encoder_was_zeroed_pulls_no_load() -> None:
    leak = {"valve_leak.area_m2": 2.5e-7}
    records = [zeroed_late(measured(program, **hidden(leak))) for program in ("fit", "judge")]
    fitted, judged = [[record] for record in records]
    assert np.mean(records[0]["pressure_pa"][:200]) > 102.0e3
    truth = with_values(PAPER, leak)
    evidence = prepare_evidence(fitted, judged, PAPER)
    driven = with_modelled_pressure(evidence, fitted, judged, truth, trusted=True)
    (drive,) = driven.holdout[MECHANICS]
    assert drive.start > 50e-6
    assert rms(drive.residual(truth)) * drive.deviation < 3 * COUNT_M


def hidden(values: dict[str, float]) -> dict[str, float]:
    return {name.replace(".", "__"): value for name, value in values.items()}


def zeroed_late(record: Record) -> Record:
    """Begin the record, and the encoder's count, when the muscle has come to rest."""
    late = slice(300, None)
    position_m = record["position_m"] - record["position_m"][300]
    return Record(
        record.name,
        record.t_s[late],
        valve_v=record["valve_v"][late],
        pressure_pa=record["pressure_pa"][late],
        position_m=position_m[late],
    )
