"""Fits end at their floor from any start, and attribute errors to the right number."""

from __future__ import annotations

import numpy as np
import pytest
from support.made_records import COUNT_M, find_candidate, measured, pair

from pamctl.diagnose import Record
from pamctl.diagnose.fitting.block_fit import fit_numbers, rms
from pamctl.diagnose.fitting.candidates import list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, RUNAWAY, stack_residuals
from pamctl.diagnose.fitting.evidence import prepare_evidence, with_modelled_pressure
from pamctl.diagnose.fitting.model_fit import fit_jointly, fit_model, recalibrate, weigh_blocks
from pamctl.diagnose.fitting.numbers import value_of, with_values
from pamctl.diagnose.naming.score import score_candidates
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()


def test_a_fit_of_the_mechanics_ends_where_no_number_improves_it() -> None:
    """Braid, stiffness and friction make a narrow valley: a coarse slope stops on its side."""
    off = {"damping_n_s_per_m": 620.0, "stiffness_n_per_m": 9300.0, "braid_length_m": 0.2316}
    hidden = {**off, "kinetic_friction_per_m": 60.0}
    evidence = prepare_evidence(*pair(**hidden), PAPER).select_blocks({MECHANICS})
    fitted = recalibrate(evidence).fit_of(MECHANICS)
    directions = np.linalg.qr(fitted.jacobian)[0]
    could_go = np.linalg.norm(directions.T @ fitted.residual) / np.linalg.norm(fitted.residual)
    assert could_go < 0.01
    assert rms(fitted.residual) < rms(stack_residuals(fitted.drives, with_values(PAPER, hidden)))


def test_a_load_is_not_attributed_to_the_zero_of_the_pressure_sensor() -> None:
    """The mechanics alone cannot tell them apart; the pressure block knows its zero."""
    base = weigh_blocks(recalibrate(prepare_evidence(*pair(external_load__force_n=1.3), PAPER)))
    load = find_candidate("external_load", base.evidence)
    start = {"external_load.force_n": 1.0}
    found = fit_jointly(fit_model(base, (load,), [start]))
    assert found.is_complete
    values = found.fit_of(MECHANICS).values
    assert values["external_load.force_n"] == pytest.approx(1.3, rel=0.05)
    assert abs(values["pressure_sensor_offset.offset_pa"]) < 50.0


def test_a_form_does_not_keep_a_number_of_another_form_that_it_does_not_fit() -> None:
    widths = {"valve_deadband__fill_width_v": 0.2, "valve_deadband__exhaust_width_v": 0.3}
    evidence = prepare_evidence(*pair(**widths), PAPER).select_blocks({PRESSURE})
    forms = [c for c in list_candidates(evidence) if c.name == "valve_deadband"]
    both = next(c for c in forms if len(c.free) == 2)
    one = next(c for c in forms if [f.name for f in c.free] == ["valve_deadband.fill_width_v"])
    base = recalibrate(evidence)
    wide = fit_model(base, (both,), [{n.replace("__", "."): v for n, v in widths.items()}])
    assert wide.effect_values["valve_deadband.exhaust_width_v"] > 0.2
    settings = fit_model(wide, (one,), [wide.effect_values]).fit_of(PRESSURE).settings
    assert value_of(settings, "valve_deadband.exhaust_width_v") == 0.0


def test_a_start_from_which_the_model_runs_away_is_moved_back() -> None:
    """With a spring this soft the muscle runs away beyond 15 mm."""
    evidence = prepare_evidence(*pair(), PAPER).select_blocks({MECHANICS})
    cubic = find_candidate("cubic_stiffness", evidence)
    wild = with_values(PAPER, {"cubic_stiffness.n_per_m3": -1e7, "stiffness_n_per_m": 7000.0})
    drives = evidence.train[MECHANICS]
    assert np.max(np.abs(stack_residuals(drives, wild))) > 0.99 * RUNAWAY
    found = fit_numbers(drives, wild, (*recalibrate(evidence).fit_of(MECHANICS).free, *cubic.free))
    assert np.all(np.abs(found.residual) < 100.0)
    assert abs(found.values["cubic_stiffness.n_per_m3"]) < 3e4


def test_an_effect_may_explain_a_number_at_the_end_of_its_range() -> None:
    evidence = prepare_evidence(*pair(end_cap__length_m=4e-3), PAPER).select_blocks({PRESSURE})
    base = recalibrate(evidence).fit_of(PRESSURE)
    assert "braid_length_m" in base.at_bound
    (score,) = score_candidates(base, [find_candidate("end_cap", evidence)], PRESSURE)
    assert score.explained > 0.3


def test_a_zero_left_by_homing_does_not_hide_a_sensor_offset() -> None:
    start = PlantSettings.model_validate(
        {"effects": {"pressure_sensor_offset": {"offset_pa": 12.0}}}
    )
    assert "pressure_sensor_offset" in {
        c.name for c in list_candidates(prepare_evidence(*pair(), start))
    }


def test_an_encoder_zeroed_while_a_leak_fills_the_muscle_shows_no_load() -> None:
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
    """Begin the record, and the encoder's count, after the muscle has come to rest."""
    late = slice(300, None)
    position_m = record["position_m"] - record["position_m"][300]
    return Record(
        record.name,
        record.t_s[late],
        valve_v=record["valve_v"][late],
        pressure_pa=record["pressure_pa"][late],
        position_m=position_m[late],
    )
