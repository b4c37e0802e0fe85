"""Effects: the required parts of each record, and what each does to the plant."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from hal.sim import SimRig, sensor_chain
from pamctl.plant import catalogue, effects
from pamctl.plant.catalogue import CATALOGUE, check_effect, load_effects, order_entries
from pamctl.plant.drive import drive_coupled, drive_mechanics, drive_pressure
from pamctl.plant.effects.description import EffectEntry, EffectForm, EffectMemory, EffectParameter
from pamctl.plant.model import PlantSettings, plant_parameters, settings_of, values_of
from pamctl.plant.parameters import NEUTRAL, PlantParameters, parameters_of
from pamctl.plant.simulated import SimulatedPlant
from pamctl.settings.resolve import resolve

TICK_S = 1e-3
COMMAND_V = np.array(
    [5.0 if i < 150 else -5.0 if i < 300 else 1.5 * math.sin(0.03 * i) for i in range(900)]
    + [0.0] * 100
)
names = pytest.mark.parametrize("name", CATALOGUE)


def switched_on(name: str, **changes: float) -> dict[str, float]:
    """An effect at the values where a fit would start."""
    return {f"{name}.{p.name}": changes.get(p.name, p.start) for p in CATALOGUE[name].parameters}


ALL_ON = {
    key: value
    for name in CATALOGUE
    for key, value in switched_on(name).items()
    if name not in ("command_delay", "moving_mass")
}
"""At once, with bristles of LuGre's kind, a tank, a line that has a volume, and two creeps."""
ALL_ON |= {
    "presliding.form": 2.0,
    "presliding.bristle_damping_n_s_per_m": 20.0,
    "supply_droop.refill_time_s": 0.05,
    "line_restriction.volume_m3": 3e-6,
    "creep.fast_share": 0.4,
    "command_delay.delay_s": 1.3e-3,
    "moving_mass.added_kg": 0.1,
}


def through_every_part(p: PlantParameters) -> PlantParameters:
    """The general equations, also without an active effect."""
    return p._replace(valve_acts=True, air_acts=True, mechanics_act=True, sensors_act=True)


# --- neutral ------------------------------------------------------------------------------------


def test_the_general_equations_at_neutral_values_are_the_papers_to_the_bit():
    paper = parameters_of({})
    expected = drive_coupled(paper, COMMAND_V, TICK_S)
    general = drive_coupled(through_every_part(paper), COMMAND_V, TICK_S)
    np.testing.assert_array_equal(np.array(general), np.array(expected))


@names
def test_an_effect_with_neutral_sizes_does_nothing_for_any_shape(name):
    shapes = {p.name: p.high for p in CATALOGUE[name].parameters if p.role == "shape"}
    neutral = {
        f"{name}.{p.name}": shapes.get(p.name, p.neutral) for p in CATALOGUE[name].parameters
    }
    p = parameters_of(neutral)
    assert not any((p.valve_acts, p.air_acts, p.mechanics_act, p.sensors_act))
    assert p.paper == parameters_of({}).paper
    if name == "line_restriction":
        return  # without resistance its volume is a dead volume, and no effect of its own
    expected = drive_coupled(parameters_of({}), COMMAND_V, TICK_S)
    general = drive_coupled(through_every_part(p), COMMAND_V, TICK_S)
    np.testing.assert_array_equal(np.array(general), np.array(expected))


# --- the blocks, and the ways to use them -------------------------------------------------------


@names
def test_the_blocks_alone_agree_with_the_coupled_plant(name):
    """Driven by sensed signals, with the sensors' own effects undone where they can be.

    The line's jumps and the sensor's lag fall between the samples: some are left. So is the way
    through a backlash, which the encoder does not show.
    """
    p = parameters_of(switched_on(name))
    coupled = drive_coupled(p, COMMAND_V, TICK_S)
    pressure = drive_pressure(p, COMMAND_V, coupled.position_m, TICK_S)
    mechanics = drive_mechanics(p, coupled.pressure_pa, TICK_S)
    paper = parameters_of({})
    near_pa, near_m = 40.0, 4e-6
    missed_pa = drive_pressure(paper, COMMAND_V, coupled.position_m, TICK_S).pressure_pa
    missed_m = drive_mechanics(paper, coupled.pressure_pa, TICK_S).position_m
    seen_by = CATALOGUE[name].seen_by

    def rms(difference: Any) -> float:
        return float(np.sqrt(np.mean(difference**2)))

    error_pa = rms(pressure.pressure_pa - coupled.pressure_pa)
    error_m = rms(mechanics.position_m - coupled.position_m)
    assert error_pa < max(near_pa, 0.1 * rms(missed_pa - coupled.pressure_pa))
    assert error_m < max(near_m, 0.1 * rms(missed_m - coupled.position_m))
    if name != "drift" and not CATALOGUE[name].unidentifiable:
        if "pressure" not in seen_by:
            assert rms(missed_pa - coupled.pressure_pa) < near_pa
        if "mechanics" not in seen_by:
            assert rms(missed_m - coupled.position_m) < near_m


def test_a_simulated_rig_reads_what_the_sensors_show():
    p = parameters_of({"pressure_sensor_offset.offset_pa": 5e3, "encoder_scale.scale": 1.05})
    settings = resolve(fast=True)
    rig: Any = settings.rig
    chain = sensor_chain(rig.sim.model_copy(update={"sensor_noise_v": 0.0}), rig.calibration)
    now_ns, plant = 0, SimulatedPlant(p)
    sim = SimRig(plant, chain, safe_output_v=0.0, now_ns=lambda: now_ns)
    sim.open()
    sim.write(10.0)
    now_ns = 500_000_000
    raw = sim.read()
    shown_pa = (raw.pressure_v - rig.sim.sensor_zero_v) * rig.calibration.sensor_pa_per_v + 101.3e3
    assert shown_pa == pytest.approx(plant.state.pressure_pa + 5e3, abs=30.0)
    shown_m = (raw.encoder_counts - 1000.4) * rig.calibration.encoder_m_per_count
    assert shown_m == pytest.approx(1.05 * plant.state.position_m, abs=3.3e-6)
    assert plant.state.position_m > 20e-3


# --- descriptions -------------------------------------------------------------------------------


def test_every_record_of_an_effect_is_in_the_catalogue():
    folder = Path(str(effects.__file__)).parent
    text = "".join(path.read_text("utf-8") for path in folder.glob("*.py"))
    assert {*re.findall(r"^(\w+) = EffectDescription\(", text, re.M)} == {
        *map(str.upper, CATALOGUE)
    }
    assert [name for name, e in CATALOGUE.items() if e.unidentifiable] == ["moving_mass"]


def is_sane(p: EffectParameter) -> bool:
    return (
        p.low <= p.neutral <= p.high
        and p.low <= p.start <= p.high
        and p.smallest_of_interest > 0.0
        and (p.role == "shape" or (p.neutral in (0.0, 1.0) and p.low < p.start < p.high))
    )


@names
def test_every_effect_is_described_so_that_a_fit_can_start(name):
    effect = CATALOGUE[name]
    assert effect.name == name
    assert effect.equation
    assert effect.signature
    assert bool(effect.best_experiment) == ("muscle" in effect.actuators and name != "moving_mass")
    assert effect.seen_by
    assert all(is_sane(p) for p in effect.parameters)
    assert {*effect.told_from} <= {*CATALOGUE} - {name}
    for form in effect.forms:
        assert any(p.role == "size" for p in effect.parameters if p.name in form.free)


@names
def test_a_plant_file_can_name_every_effect(name):
    values = switched_on(name)
    settings = settings_of(values)
    assert list(settings.effects.model_dump(exclude_none=True)) == [name]
    assert plant_parameters(settings) == parameters_of(values)
    assert values_of(settings).items() >= values.items()


def test_a_form_of_presliding_is_chosen_by_its_name():
    settings = PlantSettings.model_validate(
        {"effects": {"presliding": {"compliance_m_per_n": 1e-5, "form": "dahl"}}}
    )
    assert plant_parameters(settings).effects.mechanics.presliding.form == 1.0
    assert NEUTRAL["presliding.form"] == 0.0
    with pytest.raises(ValueError, match="elasto_plastic"):
        PlantSettings.model_validate({"effects": {"presliding": {"form": "maxwell"}}})


# --- the catalogue -------------------------------------------------------------------------------


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
def test_a_record_that_contradicts_itself_is_refused(wrong, message):
    check_effect(GOOD)
    with pytest.raises(ValueError, match=message):
        check_effect(wrong)


def test_an_old_installation_does_not_lose_the_shipped_effects(monkeypatch):
    monkeypatch.setattr(catalogue, "find_entry_points", lambda group: ())
    assert list(load_effects()) == [n for n, e in CATALOGUE.items() if is_shipped(e.kind)]


def is_shipped(kind: type) -> bool:
    return kind.__module__.startswith("pamctl.")


def test_each_effect_of_a_place_comes_after_those_whose_result_it_takes():
    order = [name for name, _ in order_entries("opening") if is_shipped(CATALOGUE[name].kind)]
    assert order == ["valve_deadband", "valve_curve", "valve_asymmetry", "drift"]
    order = [name for name, _ in order_entries("friction")]
    assert order.index("return_friction") < order.index("coulomb_friction")
    assert order.index("coulomb_friction") < order.index("stribeck")
