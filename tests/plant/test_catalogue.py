"""The catalogue of effects: the required parts of a record, and the errors of a wrong one."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import pytest

from pamctl.diagnose.evidence import pool
from pamctl.plant import catalogue
from pamctl.plant.catalogue import CATALOGUE, check_effect, load_effects, order_entries
from pamctl.plant.effects.description import EffectEntry, EffectForm, EffectMemory


class Tilt(NamedTuple):
    share: float = 0.0


def tilt_force_n(tilt: Tilt, position_m: float, weather: float) -> float:
    return tilt.share * position_m * weather


def start(position_m: float, pressure_pa: float) -> Tilt:
    return Tilt()


def follow(tilt: Tilt, memory: Tilt, end: float) -> Tilt:
    return memory


GOOD = CATALOGUE["cubic_stiffness"]
FLOW = EffectEntry("flow", lambda effect, memory: 0.0, EffectMemory(start, follow))
FORCE = EffectEntry("force", lambda effect: 0.0, EffectMemory(start, follow))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (replace(GOOD, name="my effect"), "name 'my effect'"),
        (replace(GOOD, block="hydraulics"), "block 'hydraulics'"),
        (replace(GOOD, kind=Tilt), r"Tilt\(\) must hold the neutral values {'n_per_m3': 0.0}"),
        (replace(GOOD, entries=(EffectEntry("hose", tilt_force_n),)), "place hose: there are num"),
        (replace(GOOD, entries=(EffectEntry("force", tilt_force_n),)), "no argument weather"),
        (replace(GOOD, entries=(FLOW,)), "no argument memory|cannot remember there"),
        (replace(GOOD, entries=(FORCE,)), "no argument end; its place gives memory, begin_m"),
        (replace(GOOD, forms=(EffectForm("bent", ("angle",)),)), "form bent names numbers"),
    ],
)
def test_a_record_that_contradicts_itself_is_refused(wrong, message: str) -> None:
    check_effect(GOOD)
    with pytest.raises(ValueError, match=message):
        check_effect(wrong)


def test_an_old_installation_does_not_lose_the_shipped_effects(monkeypatch) -> None:
    monkeypatch.setattr(catalogue, "find_entry_points", lambda group: ())
    assert list(load_effects()) == [n for n, e in CATALOGUE.items() if is_shipped(e.kind)]


def test_the_diagnosis_places_an_effect_by_its_file() -> None:
    places = {h.family: h.place for h in pool.list_effects("muscle", pool.PAPER_SCALES)}
    assert {places[n] for n in ("valve_leak", "valve_spool", "command_delay")} == {"valve"}
    assert {places[n] for n in ("dead_volume", "discharge_ratio", "chamber_leak")} == {"air"}
    assert {places[n] for n in ("stribeck", "presliding", "position_friction")} == {"friction"}
    assert {places[n] for n in ("creep", "cubic_stiffness", "end_cap")} == {"pull"}
    assert places["supply_droop"] == "supply"


def is_shipped(kind: type) -> bool:
    return kind.__module__.startswith("pamctl.")


def test_each_effect_of_a_place_comes_after_those_whose_result_it_takes() -> None:
    order = [name for name, _ in order_entries("opening") if is_shipped(CATALOGUE[name].kind)]
    assert order == ["valve_deadband", "valve_curve", "valve_asymmetry", "drift"]
    order = [name for name, _ in order_entries("friction")]
    assert order.index("return_friction") < order.index("coulomb_friction")
    assert order.index("coulomb_friction") < order.index("stribeck")
