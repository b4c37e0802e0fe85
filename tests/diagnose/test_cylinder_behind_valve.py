"""A cylinder of other code: what its valve lacks is named, beside the numbers of its plant file."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.cylinder import Array, Cylinder, LiftingMuscle, excite
from support.made_records import ask_only, list_asked

from pamctl.diagnose import Diagnosis, Record, diagnose
from pamctl.diagnose.evidence.fit import WeighedModel
from pamctl.diagnose.evidence.measuring_chain import STOP
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.weigh import list_pool, prepare_weigher
from pamctl.diagnose.report.finding_words import list_faults
from pamctl.plant.model import PlantSettings

T_S = np.arange(0.0, 5.0, 2e-3)
GUESSED = Cylinder(
    stroke_m=0.2, mass_kg=1.0, damping_n_s_per_m=60.0, stiffness_n_per_m=1650.0,
    gain_m2_per_v=2.6e-7, preload_n=25.0, volume_m3=3.4e-5,
)  # fmt: skip
"""The plant file: numbers 10 to 25 % wrong."""


@cache
def record(cylinder: Cylinder, seed: int) -> Record:
    """Return the readings of a noisy pressure sensor and of an encoder with steps of 10 um."""
    chance = np.random.default_rng(seed)
    commands: Array = (0.8 + 0.1 * seed) * excite(T_S * (1.0 + 0.07 * seed))
    position_m, pressure_pa = cylinder.simulate(T_S, commands)
    read_m = np.round((position_m + chance.normal(0.0, 5e-6, len(T_S))) / 1e-5) * 1e-5
    read_pa = pressure_pa + chance.normal(0.0, 300.0, len(T_S))
    return Record(f"run {seed}", T_S, valve_v=commands, pressure_pa=read_pa, position_m=read_m)


def diagnose_asking(
    train: list[Record], held_out: list[Record], plant: PlantSettings, *asked: str
) -> Diagnosis:
    without = ask_only(*asked, of=list_asked(train, plant))
    return diagnose(train, held_out, plant, without=without)


@pytest.mark.long
def test_dead_band_and_leak_are_named_from_valve_pressure_and_position_together():
    rig = Cylinder(stroke_m=0.2, dead_band_v=0.3, leak_m2=2e-8)
    asked = "deadband", "leak", "valve_curve", "opening~", "flow~", "supply", "friction"
    found = diagnose_asking([record(rig, 1)], [record(rig, 2)], GUESSED.plant(), *asked)
    assert {f.name for f in found.findings} == {"valve_deadband", "chamber_leak"}
    numbers = {n.name: n for f in found.findings for n in f.numbers}
    for name, true in (
        ("valve_deadband.fill_width_v", 0.3),
        ("valve_deadband.exhaust_width_v", 0.3),
        ("chamber_leak.area_m2", 2e-8),
    ):
        assert numbers[name].value == pytest.approx(true, rel=0.03), name


@pytest.mark.long
def test_a_model_that_was_led_astray_is_fitted_anew_from_the_numbers_of_the_plant_file():
    rig, plant = Cylinder(stroke_m=0.2, coulomb_n=15.0, exponent=1.4), GUESSED.plant()
    weigher, start = prepare_weigher([record(rig, 1), record(rig, 2)], [], plant)
    pool = {h.name: h for h in list_pool(weigher.train, weigher.base, plant)}
    names = ("coulomb_friction", "polytropic")
    friction = pool["coulomb_friction"].variants[0]
    air = max(pool["polytropic"].variants, key=lambda v: len(v.free))
    freed = [*friction.free, *air.free]
    astray = [3.0 * n.value for n in start.numbers]
    m = WeighedModel(
        names, (*start.numbers, *freed), {**friction.held, **air.held},
        np.array([*astray, *(u.value for u in freed)]),
        {"coulomb_friction": friction, "polytropic": air},
    )  # fmt: skip
    weigher.refine(m)
    weigher.set_floor(m)
    weigher.leave_out(m)
    found = NameSearch(weigher, pool).settle_anew(m).values
    assert found["coulomb_friction.force_n"] == pytest.approx(15.0, rel=0.02)
    assert found["polytropic.exponent"] == pytest.approx(1.4, abs=0.01)
    assert found["mass_kg"] == pytest.approx(rig.mass_kg, rel=0.02)
    assert found["cylinder_volume_m3"] == pytest.approx(rig.volume_m3, rel=0.02)


@pytest.mark.long
def test_a_piston_that_was_homed_off_its_end_is_no_scale_of_the_encoder():
    """Friction holds it 10 mm off its end, and the far end is then seen 10 mm nearer."""
    rig = Cylinder(coulomb_n=15.0, preload_n=0.0, gain_m2_per_v=6e-7)
    run = record(rig, 1)
    homed = [replace(run, position_m=np.asarray(run.position_m) - 0.01)]
    asked = "coulomb_friction", "stop", "encoder_scale", "encoder~curve", "position_late"
    found = diagnose_asking(homed, [], rig.plant(), *asked)
    assert {f.name for f in found.findings[:2]} == {"coulomb_friction", "end_stop"}
    (fault,) = list_faults(found) or [None]
    named = {f.name for f in found.findings if f.level == "name"}
    assert "encoder_scale" not in named
    assert fault is None or fault.value == pytest.approx(-0.01, abs=2e-4)
    numbers = {n.name: n.value for n in found.evidence.recalibrated}
    assert numbers["mass_kg"] == pytest.approx(rig.mass_kg, rel=0.03)
    assert numbers["stiffness_n_per_m"] == pytest.approx(rig.stiffness_n_per_m, rel=0.03)


@pytest.mark.long
def test_a_rubber_bumper_is_a_force_that_begins_there_and_no_nearer_end_of_the_stroke():
    rig = Cylinder(stroke_m=0.1, coulomb_n=10.0, bumper_m=0.06, bumper_n_per_m=2e4)
    runs = [record(rig, 1), record(rig, 2)]
    assert max(np.max(run.position_m) for run in runs) > 0.065
    asked = "coulomb_friction", "stop", "encoder_scale", "encoder~curve", "force~", "cubic"
    found = diagnose_asking(runs, [], rig.plant(), *asked)
    assert {f.name for f in found.findings} == {"coulomb_friction", "force~beyond(position)"}
    numbers = {n.name: n.value for f in found.findings for n in f.numbers}
    assert numbers["force_term.inner"] == pytest.approx(0.06, rel=0.01)
    assert numbers["force_term.size"] == pytest.approx(-200.0, rel=0.03)  # for each 10 mm


def test_where_both_ends_are_seen_the_zero_of_the_position_is_off():
    rig = Cylinder(preload_n=0.0, gain_m2_per_v=6e-7)
    seen = record(rig, 1)
    homed = replace(seen, position_m=np.asarray(seen.position_m) - 0.01)
    weigher, start = prepare_weigher([homed], [], rig.plant())
    (end,) = (h for h in list_pool(weigher.train, weigher.base, rig.plant()) if h.kind == STOP)
    (zero,) = end.variants[0].sizes
    assert zero.value == pytest.approx(-0.01, abs=1e-3)
    off = {
        value: np.sqrt(np.mean(weigher.find_residual({**start.values, zero.name: value})[0] ** 2))
        for value in (-0.01, 0.0)
    }
    assert off[-0.01] < 0.1 * off[0.0]


def fit_lifting_muscle(
    stated: str, value: float, *known: str, guessed: Sequence[str] = ()
) -> dict[str, float]:
    """Return the fitted numbers of a muscle of which the plant file states one wrong."""
    muscle, commands = LiftingMuscle(), excite(T_S) - 1.0
    position_m, pressure_pa = muscle.simulate(T_S, commands)
    lifted = Record("lifted", T_S, commands, pressure_pa, np.round(position_m / 1e-6) * 1e-6)
    data = muscle.plant().model_dump(exclude_none=True)
    data["parameters"][stated] = value
    data |= {"known": known, "guessed": guessed}
    weigher, start = prepare_weigher([lifted], [], PlantSettings.model_validate(data))
    return weigher.settle(start, 12).values


def test_of_a_muscle_whose_braid_does_not_rub_the_fitted_friction_goes_to_zero():
    found = fit_lifting_muscle("kinetic_friction_per_m", 55.3)
    assert found["kinetic_friction_per_m"] < 0.5
    assert found["external_load.force_n"] == pytest.approx(LiftingMuscle().preload_n, rel=0.005)


def test_a_braid_of_the_wrong_width_is_fitted_as_another_mass_and_load_of_the_same_motion():
    """The pull is 1.21 times too small: so are all forces, and the motion is the same."""
    rig = LiftingMuscle()
    found = fit_lifting_muscle("braid_turns", 1.1 * rig.turns)
    for name, true in (
        ("mass_kg", rig.mass_kg), ("external_load.force_n", rig.preload_n),
        ("damping_n_s_per_m", rig.damping_n_s_per_m),
    ):  # fmt: skip
        assert found[name] == pytest.approx(true / 1.21, rel=0.01)


def test_a_valve_of_first_order_is_named_with_its_time_and_not_a_law_without_a_name():
    rig, fine_s, lag_s = Cylinder(stroke_m=0.2), np.arange(0.0, 4.0, 5e-4), 18e-3
    commands = np.repeat(excite(fine_s[::4]), 4)
    lag_v, opened, half = 0.0, np.empty(len(fine_s)), np.exp(-2.5e-4 / lag_s)
    for k, command in enumerate(commands):
        opened[k] = command + (lag_v - command) * half  # in the middle of the interval
        lag_v = command + (opened[k] - command) * half
    position_m, pressure_pa = (row[::4] for row in rig.simulate(fine_s, opened))
    noisy_pa = pressure_pa + np.random.default_rng(5).normal(0.0, 300.0, len(pressure_pa))
    lagging = Record("lagging", fine_s[::4], commands[::4], noisy_pa, position_m)
    asked = "valve_spool", "command~lag", "command_delay", "pressure_late", "pressure_sensor_lag"
    found = diagnose_asking([lagging], [], rig.plant(), *asked)
    assert [f.name for f in found.findings if f.level == "name"] == ["valve_spool"]
    assert found.evidence is not None
    assert found.evidence.values["valve_spool.order"] == 1.0
    assert found.evidence.values["valve_spool.time_constant_s"] == pytest.approx(lag_s, rel=0.05)


def test_a_braid_of_the_wrong_width_is_found_by_a_mass_that_was_weighed():
    rig = LiftingMuscle()
    found = fit_lifting_muscle("braid_turns", 1.1 * rig.turns, "mass_kg")
    assert found["braid_turns"] == pytest.approx(rig.turns, rel=0.001)
    assert found["external_load.force_n"] == pytest.approx(rig.preload_n, rel=0.002)
    assert found["valve_gain_m2_per_v"] == pytest.approx(rig.gain_m2_per_v, rel=0.005)


def test_a_supply_that_was_guessed_is_looked_for_further_away_than_one_that_was_read() -> None:
    rig = LiftingMuscle()
    wrong_pa = 0.7 * rig.supply_pa
    (guess,) = guessed = ("tank_pressure_pa",)
    assert fit_lifting_muscle(guess, wrong_pa, guessed=guessed)[guess] == pytest.approx(
        rig.supply_pa, rel=0.01
    )
    assert fit_lifting_muscle(guess, wrong_pa)[guess] < 0.85 * rig.supply_pa


def test_a_number_cannot_be_known_and_guessed() -> None:
    with pytest.raises(ValueError, match="mass_kg is either known or guessed"):
        PlantSettings.model_validate({"known": ["mass_kg"], "guessed": ["mass_kg"]})
