"""What the diagnosis gets wrong today, or says less than the data carry; each case with its reason.

A case that becomes right fails here: then it moves to the tests of its subject.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
from diagnose.test_play_in_windows import MASS_KG, diagnose_belt
from diagnose.test_tank import CRITICAL, diagnose_tank
from hidden.excitations import brief
from hidden.rig import hidden_rig
from support.made_records import all_but, measured, numbers_of, pair

from pamctl.diagnose import Record, Verdict, diagnose, sentence
from pamctl.diagnose.audit import audit_run
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.finding_words import list_ambiguous
from pamctl.plant.model import PlantSettings

pytestmark = pytest.mark.long
PAPER = PlantSettings()


def wrong(reason: str) -> pytest.MarkDecorator:
    return pytest.mark.xfail(strict=True, reason=reason)


# --- a wrong number in a narrow interval ---------------------------------------------------------


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


@wrong("the audit calls it seen")
def test_full_scale_squares_cannot_show_a_dead_band() -> None:
    audit = audit_run(measured("squares"), PAPER)
    assert "valve_deadband" in {spot.name for spot in audit.blind_spots}
    assert "valve_deadband" in audit_run(measured("fit"), PAPER).sees
