"""Causes that hide behind each other, on rigs of another author's solver."""

import pytest
from hidden.examination.cases import Case
from support.made_records import ask_only, names_of, numbers_of, pair, to_records

from pamctl.diagnose import Diagnosis, Verdict, diagnose
from pamctl.diagnose.report.finding_words import list_ambiguous, list_faults
from pamctl.plant.model import PlantSettings


def _diagnose(case: Case, *asked: str) -> Diagnosis:
    """Diagnose a case; `asked` are the effects and laws that may be named."""
    return diagnose(*to_records(case.records()), case.start_plant(), without=ask_only(*asked))


def test_a_dead_volume_is_told_from_a_line_and_a_scale():
    case = Case("single/dead_volume/3", "single", {"dead_volume": 3}, program="brief", repeat=1)
    found = _diagnose(case, "dead_volume", "line_restriction", "encoder_scale", "volume~")
    assert names_of(found) == ["dead_volume"]
    (volume,) = (n for n in found.numbers if n.name == "dead_volume.volume_m3")
    assert volume.value == pytest.approx(case.rig.truth.dead_m3, rel=0.05)


def test_a_ratio_of_heat_capacities_is_no_rival_of_the_valve():
    case = Case("discharge", "single", {"discharge_ratio": 1}, program="brief")
    found = _diagnose(case, "discharge_ratio", "valve_curve", "flow~")
    assert found.verdict is Verdict.NAMED
    assert names_of(found) == ["discharge_ratio"]


def test_a_small_scale_of_the_encoder_is_told_from_springs_and_not_from_a_length():
    case = Case("single/encoder_scale/1", "single", {"encoder_scale": 1}, program="brief", repeat=1)
    found = _diagnose(case, "encoder_scale", "rest_length", "cubic_stiffness", "creep")
    (members,) = list_ambiguous(found)
    assert {*members} == {"encoder_scale", "rest_length_m"}
    assert found.gap["position_m"].extended < 1.2 * found.gap["position_m"].floor


def test_the_width_of_a_play_is_found_with_the_pressure_of_the_muscle_behind_it():
    case = Case("play", "single", {"encoder_backlash": 10}, program="brief")
    found = _diagnose(case, "encoder", "coulomb_friction", "hysteresis", "presliding")
    assert found.verdict is Verdict.NAMED
    width_m = numbers_of(found)["encoder_backlash.width_m"]
    assert width_m == pytest.approx(case.rig.truth.backlash_m, abs=2e-6)


def test_steep_stribeck_friction_is_named_with_its_numbers():
    case = Case("single/stribeck/10", "single", {"stribeck": 10}, program="brief")
    found = _diagnose(case, "stribeck", "coulomb_friction", "damping~")
    assert names_of(found) == ["stribeck"]
    truth, values = case.rig.truth, numbers_of(found)
    assert values["stribeck.rise"] == pytest.approx(truth.stribeck, rel=0.02)
    assert values["stribeck.speed_m_per_s"] == pytest.approx(truth.stribeck_m_per_s, rel=0.05)


def test_a_quick_valve_behind_a_dead_band_is_no_delay():
    case = Case("pair/deadband+spool", "pair", {"valve_deadband": 5.0, "valve_spool": 3.0},
                program="brief", repeat=96)  # fmt: skip
    found = _diagnose(case, "deadband", "spool", "slew", "valve_curve", "command_delay")
    assert set(names_of(found)) == {"valve_deadband", "valve_spool"}
    true_s = 1.0 / case.rig.truth.spool_rad_per_s
    assert numbers_of(found)["valve_spool.time_constant_s"] == pytest.approx(true_s, rel=0.02)


def test_a_load_that_was_not_weighed_is_a_mass_and_no_late_column():
    case = Case("unknown/moving_mass", "unknown", {"moving_mass": 10}, program="brief")
    found = _diagnose(case, "mass", "late", "clock", "delay", "lag", "friction", "force~", "creep")
    assert found.verdict is Verdict.MISCALIBRATED
    (fault,) = list_faults(found)
    assert (fault.kind, fault.number) == ("plant_constant", "mass_kg")
    assert fault.value == pytest.approx(case.rig.truth.mass_kg, rel=0.02)


def test_a_drooping_supply_is_named_beside_a_hysteretic_spring():
    hidden = {
        "supply_droop__resistance_pa_s_per_kg": 2e7,
        "spring_hysteresis__force_n": 2.5,
        "spring_hysteresis__way_m": 1.5e-3,
    }
    asked = ask_only("supply", "chamber_leak", "force~hysteresis")
    found = diagnose(*pair(**hidden), PlantSettings(), without=asked)
    assert names_of(found) == ["supply_droop"]
    droop = numbers_of(found)["supply_droop.resistance_pa_s_per_kg"]
    assert droop == pytest.approx(2e7, rel=0.05)
