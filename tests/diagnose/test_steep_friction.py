"""Steep friction: the right name in spite of valleys and of coarse steps."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden.examination.cases import Case
from hidden.examination.examine import records_of, rig_of, start_plant
from support.made_records import names_of, numbers_of, to_records

from pamctl.diagnose import Verdict, diagnose
from pamctl.plant.catalogue import CATALOGUE

FRICTION = {"stribeck", "coulomb_friction"}


@pytest.mark.long
@pytest.mark.parametrize(
    "case",
    [
        Case("form/stribeck-tustin/10", "form", {"stribeck": (10, "tustin")}),  # needs windows
        Case("single/stribeck/10", "single", {"stribeck": 10}),  # needs finer steps
    ],
    ids=lambda case: case.id,
)
def test_steep_stribeck_friction_is_named_with_its_numbers(case: Case) -> None:
    case = replace(case, program="brief")
    found = diagnose(
        *to_records(records_of(case)), start_plant(case), without=CATALOGUE.keys() - FRICTION
    )
    assert found.verdict is Verdict.NAMED
    assert names_of(found) == ["stribeck"]
    truth, values = rig_of(case).truth, numbers_of(found)
    assert values["stribeck.rise"] == pytest.approx(truth.stribeck, rel=0.02)
    assert values["stribeck.speed_m_per_s"] == pytest.approx(truth.stribeck_m_per_s, rel=0.05)
