"""What the diagnosis gets wrong today, or says less than the data carry; each case with its reason.

A case that becomes right fails here: then it moves to the tests of its subject.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnose.test_play_in_windows import MASS_KG, diagnose_belt
from diagnose.test_setup import diagnose_spoiled
from diagnose.test_tank import CRITICAL, diagnose_tank
from hidden.examination.cases import Case
from hidden.examination.examine import records_of, rig_of, start_plant
from hidden.excitations import brief
from hidden.rig import hidden_rig
from support.made_records import all_but, measured, names_of, numbers_of, pair, to_records

from pamctl.diagnose import Record, Verdict, diagnose, sentence
from pamctl.diagnose.audit import audit_run
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.finding_words import list_ambiguous, list_faults
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings

pytestmark = pytest.mark.long
PAPER = PlantSettings()


def wrong(reason: str) -> pytest.MarkDecorator:
    return pytest.mark.xfail(strict=True, reason=reason)


# --- a wrong number in a narrow interval ---------------------------------------------------------


@wrong("the rise comes out 0.26 instead of 0.44, or a set with what is no cause")
def test_steep_stribeck_friction_of_another_form_is_named_with_its_numbers() -> None:
    case = Case("form/stribeck-tustin/10", "form", {"stribeck": (10, "tustin")}, program="brief")
    few = CATALOGUE.keys() - {"stribeck", "coulomb_friction"}
    found = diagnose(*to_records(records_of(case)), start_plant(case), without=few)
    assert names_of(found) == ["stribeck"]
    truth, values = rig_of(case).truth, numbers_of(found)
    assert values["stribeck.rise"] == pytest.approx(truth.stribeck, rel=0.02)
    assert values["stribeck.speed_m_per_s"] == pytest.approx(truth.stribeck_m_per_s, rel=0.05)


def test_the_mass_behind_a_play() -> None:
    found = diagnose_belt()
    assert found.verdict is Verdict.NAMED
    assert numbers_of(found)["mass_kg"] == pytest.approx(MASS_KG, rel=0.01)


@wrong("one finding of three; many times the noise is left, and the sentence says so")
def test_three_effects_of_a_tank_that_hide_behind_each_other_are_found_together() -> None:
    found = diagnose_tank()
    values = numbers_of(found)
    assert found.gap["pressure_pa"].extended < 1.5 * found.gap["pressure_pa"].floor
    assert values["polytropic.exponent"] == pytest.approx(1.4, abs=0.02)
    assert 0.528 + values["discharge_ratio.shift"] == pytest.approx(CRITICAL, abs=0.03)


@wrong("neither is asked once the polytropic exponent is in the model")
def test_an_on_off_valve_cannot_tell_a_dead_band_from_a_weaker_exhaust() -> None:
    (members,) = list_ambiguous(diagnose_tank())
    assert {"valve_deadband", "valve_asymmetry"} <= {*members}


# --- less than the data carry --------------------------------------------------------------------


@wrong("nothing explains it: the pool has no number that differs between records")
def test_a_stiffness_that_differs_between_records_is_said_as_the_stiffness() -> None:
    rig, parts, place = hidden_rig(seed=7), [], 0
    for part in brief(3):
        parts.append([])
        for e in part:
            truth = rig.truth._replace(stiffness=rig.truth.stiffness * (1.0 - 0.02 * place))
            run = replace(rig, truth=truth).run(e).record
            parts[-1].append(Record(f"{run.name}-{place}", **run.columns()))
            place += 1
    found = diagnose(*parts, PAPER)
    assert "stiffness" in sentence(found)


def test_a_drooping_supply_is_named_beside_a_hysteretic_spring() -> None:
    hidden = {
        "supply_droop__resistance_pa_s_per_kg": 2e7,
        "spring_hysteresis__force_n": 2.5,
        "spring_hysteresis__way_m": 1.5e-3,
    }
    few = all_but("supply_droop", "chamber_leak")
    document = build_diagnosis_document(diagnose(*pair(**hidden), PAPER, without=few))
    (effect,) = document["effects"]
    assert effect["name"] == "supply_droop"
    droop = effect["parameters"]["resistance_pa_s_per_kg"]
    assert droop["value"] == pytest.approx(2e7, rel=0.05)


@wrong("not asked yet")
def test_commands_that_were_read_back_late_are_said() -> None:
    def read_back(record: Record) -> Record:
        random = np.random.default_rng(5)
        t_s = record.t_s + random.exponential(20e-6, len(record))
        rows = [np.flatnonzero(t_s <= t - 1e-3 + 1e-9)[-1:].sum() for t in t_s]
        return replace(record, t_s=t_s, valve_v=record["valve_v"][np.array(rows)])

    found = diagnose_spoiled(hidden_rig({}, seed=8), read_back)
    assert [(f.kind, f.number) for f in list_faults(found)] == [("skew", "valve_v")]
    assert list_faults(found)[0].value == pytest.approx(1e-3, abs=1e-4)


@wrong("the audit calls it seen")
def test_full_scale_squares_cannot_show_a_dead_band() -> None:
    audit = audit_run(measured("squares"), PAPER)
    assert "valve_deadband" in {spot.name for spot in audit.blind_spots}
    assert "valve_deadband" in audit_run(measured("fit"), PAPER).sees
