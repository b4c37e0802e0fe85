"""Causes that hide behind each other: a length behind an effect, an effect behind a length."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import pytest
from hidden.examination.cases import Case
from hidden.examination.examine import records_of, rig_of, start_plant

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings


def _diagnose(
    case: Case, among: Iterable[str] = CATALOGUE, plant: PlantSettings | None = None
) -> Diagnosis:
    """Diagnose a rig of another author's solver; `among` are the effects that may be named."""
    train, held = ([Record(name=r.name, **r.columns()) for r in part] for part in records_of(case))
    return diagnose(train, held, plant or start_plant(case), without=CATALOGUE.keys() - {*among})


def _with_heat_capacity_ratio(plant: PlantSettings, ratio: float) -> PlantSettings:
    parameters = plant.parameters.model_copy(update={"heat_capacity_ratio": ratio})
    return plant.model_copy(update={"parameters": parameters})


@pytest.mark.long
def test_a_scale_that_explains_all_is_corrected_where_an_effect_explains_less() -> None:
    case = Case("left_out/encoder_scale", "left_out", {"encoder_scale": 3}, program="brief")
    found = _diagnose(case, ("cubic_stiffness", "stribeck", "creep"))
    assert found.verdict is Verdict.MISCALIBRATED
    (finding,) = found.setup
    assert (finding.kind, finding.number, finding.is_corrected) == ("scale", "position_m", True)
    assert finding.value == pytest.approx(rig_of(case).sensors.encoder_scale, abs=2e-3)


@pytest.mark.long
def test_a_dead_volume_that_the_braids_length_hides_is_named_by_both_blocks() -> None:
    """The pressure alone is at its limit; a line without resistance has such a volume as well."""
    case = Case("single/dead_volume/3", "single", {"dead_volume": 3}, program="short", repeat=1)
    among = ("dead_volume", "line_restriction", "encoder_scale", "cubic_stiffness")
    found = _diagnose(case, among)
    assert found.base is not None
    assert found.base.unexplained == ("mechanics",)
    assert found.verdict is Verdict.NAMED
    (standing,) = found.standings
    assert standing.effect.name == "dead_volume"
    assert {r.name for r in standing.rivals} >= {"line_restriction", "encoder_scale"}
    (volume,) = (n for n in found.numbers if n.name == "dead_volume.volume_m3")
    assert volume.low < rig_of(case).truth.dead_m3 < volume.high


@pytest.mark.long
def test_the_muscle_rests_where_a_leak_holds_it_before_the_leaks_form_is_known() -> None:
    """This rig's leak falls in one step; the catalogue's forms leave something of the pressure."""
    case = Case("single/valve_leak/10", "single", {"valve_leak": 10}, program="brief", repeat=1)
    found = _diagnose(case, ("valve_leak",))
    assert found.model is not None
    assert found.model.names == ("valve_leak",)
    assert found.model.is_explained("mechanics")
    area_m2 = found.model.effect_values["valve_leak.area_m2"]
    assert area_m2 == pytest.approx(rig_of(case).truth.null_leak_m2, rel=0.05)


def test_a_ratio_of_heat_capacities_that_no_gas_has_is_no_rival_of_the_valve() -> None:
    case = Case("discharge", "single", {"discharge_ratio": 1}, program="brief")
    found = _diagnose(case, ("discharge_ratio", "valve_curve"))
    assert found.verdict is Verdict.NAMED
    assert not found.setup


@pytest.mark.long
def test_a_wrong_ratio_of_heat_capacities_is_found() -> None:
    case = Case("gas", "null", {}, program="brief")
    plant = _with_heat_capacity_ratio(start_plant(case), 1.2)
    found = _diagnose(case, ("discharge_ratio", "valve_curve"), plant)
    (finding,) = found.setup
    assert finding.number == "heat_capacity_ratio"
    assert finding.value == pytest.approx(1.4, abs=0.005)


@pytest.mark.long
def test_a_small_effect_is_named_though_it_leaves_less_than_a_count_of_the_encoder() -> None:
    case = Case("single/encoder_scale/1", "single", {"encoder_scale": 1}, program="brief", repeat=1)
    found = _diagnose(case, ("encoder_scale", "cubic_stiffness", "creep"))
    assert found.base is not None
    assert found.base.evidence.strict
    loose = replace(found.base, evidence=replace(found.base.evidence, strict=frozenset()))
    assert not loose.unexplained
    assert [standing.effect.name for standing in found.standings] == ["encoder_scale"]
    scale = found.model.effect_values["encoder_scale.scale"] if found.model else 1.0
    assert scale == pytest.approx(rig_of(case).sensors.encoder_scale, abs=5e-4)
