"""A play of the encoder: the pressure is simulated by a motion that is not the muscle's."""

from __future__ import annotations

import pytest
from hidden.examination.cases import Case
from hidden.examination.examine import records_of, rig_of, start_plant

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.plant.catalogue import CATALOGUE


@pytest.mark.long
def test_the_width_of_a_play_is_found_with_the_pressure_of_the_muscle_behind_it() -> None:
    """By the shown motion's pressure it comes out two steps of the encoder too wide."""
    case = Case("play", "single", {"encoder_backlash": 10}, program="short")
    train, held = ([Record(name=r.name, **r.columns()) for r in part] for part in records_of(case))
    few = CATALOGUE.keys() - {"encoder_backlash", "coulomb_friction"}
    said: list[str] = []
    found = diagnose(train, held, start_plant(case), without=few, progress=said.append)
    assert "the pressure that the muscle has behind encoder_backlash" in said
    assert found.verdict is Verdict.NAMED
    (width,) = (n for n in found.numbers if n.name == "encoder_backlash.width_m")
    truth_m = rig_of(case).truth.backlash_m
    assert width.low < truth_m < width.high
    assert abs(width.value - truth_m) < 2e-6
