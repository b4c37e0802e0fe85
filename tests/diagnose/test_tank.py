"""What a tank lacks beside its plant file: heat to the walls, another valve, a weaker exhaust."""

import pytest
from support.made_records import numbers_of
from support.tank import CRITICAL, VENTING, diagnose_tank

from pamctl.diagnose.report.finding_words import list_ambiguous

pytestmark = pytest.mark.long


def test_three_effects_of_a_tank_that_hide_behind_each_other_are_found_together():
    found = diagnose_tank()
    values = numbers_of(found)
    assert found.gap["pressure_pa"].extended < 1.5 * found.gap["pressure_pa"].floor
    assert values["polytropic.exponent"] == pytest.approx(1.4, abs=0.02)
    assert 0.528 + values["discharge_ratio.shift"] == pytest.approx(CRITICAL, abs=0.03)
    assert values["valve_asymmetry.exhaust_gain"] == pytest.approx(VENTING, abs=0.01)


@pytest.mark.xfail(strict=True, reason="a dead band has one number more, and is taken as beaten")
def test_an_on_off_valve_cannot_tell_a_dead_band_from_a_weaker_exhaust():
    (members,) = list_ambiguous(diagnose_tank())
    assert {"valve_deadband", "valve_asymmetry"} <= {*members}
