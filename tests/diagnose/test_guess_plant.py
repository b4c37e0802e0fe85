"""First guesses from records: an axis and a chamber that another solver made."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.cylinder import LiftingMuscle, excite

from pamctl.diagnose.guess_plant import doubt_numbers, guess_numbers
from pamctl.diagnose.record import Record
from pamctl.plant.model import PlantSettings, values_of
from pamctl.plant.parameters import PAPER

PERIOD_S = 2e-3
T_S = np.arange(0.0, 12.0, PERIOD_S)


def move_axis(mass_kg: float, damping: float, stiffness: float, dry_n: float) -> Record:
    """Return an axis that a force of several frequencies moves, friction smoothed by 1 mm/s."""

    def force_n(t: float) -> float:
        return float(40.0 * np.sin(3.0 * t) + 25.0 * np.sin(11.0 * t + 1.0))

    def rates(t: float, y: np.ndarray) -> list[float]:
        friction = damping * y[1] + dry_n * np.tanh(y[1] / 1e-3)
        return [y[1], (force_n(t) - friction - stiffness * y[0]) / mass_kg]

    found = solve_ivp(rates, (0.0, T_S[-1]), [0.0, 0.0], "LSODA", T_S, rtol=1e-8, atol=1e-10)
    return Record("axis", T_S, position_m=found.y[0], force_n=np.array([*map(force_n, T_S)]))


def test_mass_damping_and_spring_of_an_axis_are_guessed_within_a_third():
    record = move_axis(4.0, 60.0, 900.0, 6.0)
    found = guess_numbers([record], "direct", {**PAPER, "atmospheric_pressure_pa": 1e5})
    for name, true in (("mass_kg", 4.0), ("damping_n_s_per_m", 60.0), ("stiffness_n_per_m", 900.0)):
        assert found[name].value == pytest.approx(true, rel=0.33), name


def test_an_axis_that_the_pressure_on_a_piston_drives_is_guessed_as_by_its_force():
    record, area_m2 = move_axis(4.0, 60.0, 900.0, 6.0), -3e-4
    values = {**PAPER, "atmospheric_pressure_pa": 1e5, "piston.area_m2": area_m2}
    by_air = replace(record, pressure_pa=1e5 + record["force_n"] / area_m2, force_n=None)
    found = guess_numbers([by_air], "direct", values)
    assert found == guess_numbers([record], "direct", values)
    assert not guess_numbers([by_air], "direct", {**values, "piston.area_m2": 0.0})


def test_a_spring_that_is_not_there_is_guessed_small():
    record = move_axis(4.0, 60.0, 0.0, 6.0)
    found = guess_numbers([record], "direct", {**PAPER, "atmospheric_pressure_pa": 1e5})
    travel_m = np.ptp(record.position_m)
    assert found["stiffness_n_per_m"].value * travel_m < 0.1 * 65.0


def move_muscle(
    return_share: float,
    drag_share: float,
    mu_k_per_m: float = 55.3,
    dry_n: float = 0.0,
    creep_n_per_m: float = 0.0,
    falls_per_m: float = 0.0,
) -> Record:
    """Return a muscle under a pressure of several frequencies, friction smoothed by 1 mm/s.

    It has the paper's numbers, but a mass that shows, a load of 40 N and a soft spring: so it
    moves by 40 mm. What creeps follows within 2 s.
    """
    turns, braid_m, rest_m, grip = 1.94, 0.232, 0.2, mu_k_per_m * 100.0 * 0.233e-6

    def gauge_pa(t: float) -> float:
        return float(2.2e5 + 1.6e5 * np.sin(1.7 * t) + 4e4 * np.sin(11.0 * t + 1.0))

    def rates(t: float, y: np.ndarray) -> list[float]:
        length_m = rest_m - y[0]
        area_m2 = (3.0 * length_m**2 - braid_m**2) / (4.0 * np.pi * turns**2)
        lever_m = length_m * np.arccos(length_m / braid_m) * (1.0 - falls_per_m * y[0])
        contracts = 0.5 + 0.5 * np.tanh(y[1] / 1e-3)
        braid_n = grip * gauge_pa(t) * lever_m * (contracts - return_share * (1.0 - contracts))
        drag_n = (1.0 + drag_share) * grip * gauge_pa(t) * y[1] * contracts
        pull_n = gauge_pa(t) * area_m2 - 1500.0 * y[0] - creep_n_per_m * (y[0] - y[2]) - 40.0
        rub_n = braid_n + dry_n * (2.0 * contracts - 1.0)
        return [y[1], (pull_n - rub_n - drag_n - 200.0 * y[1]) / 6.0, (y[0] - y[2]) / 2.0]

    start = [20e-3, 0.0, 20e-3]
    found = solve_ivp(rates, (0.0, T_S[-1]), start, "LSODA", T_S, rtol=1e-8, atol=1e-10)
    pressure = 101.3e3 + np.array([*map(gauge_pa, T_S)])
    return Record("muscle", T_S, position_m=found.y[0], pressure_pa=pressure)


FRICTIONS = (DRY, BACK, DRAG) = (
    "coulomb_friction.force_n", "return_friction.share", "braid_drag.share",
)  # fmt: skip


def test_a_part_of_the_friction_while_the_muscle_lengthens_is_guessed_where_it_shows():
    found = guess_numbers([move_muscle(0.6, 0.0)], "muscle", PAPER)
    assert found[BACK].value == pytest.approx(0.6, abs=0.15)
    assert not {DRY, DRAG} & {*found}


@pytest.mark.parametrize("creep_n_per_m", [0.0, 1200.0])
@pytest.mark.parametrize(
    ("hidden", "named"),
    [
        ({"return_share": 1.0, "drag_share": -1.0}, {BACK: 1.0, DRAG: -1.0}),
        ({"return_share": 0.0, "drag_share": 0.0}, {}),
        ({"return_share": 0.0, "drag_share": 0.0, "mu_k_per_m": 0.0, "dry_n": 8.0}, {DRY: 8.0}),
        (
            {"return_share": 1.0, "drag_share": -1.0, "mu_k_per_m": 30.0, "dry_n": 8.0},
            {BACK: 1.0, DRAG: -1.0, DRY: 8.0},
        ),
    ],
    ids=["both ways", "as in the paper", "off the braid", "both ways and off the braid"],
)
def test_a_muscle_gets_the_friction_that_it_has_whether_its_rubber_creeps_or_not(
    hidden, named, creep_n_per_m
):
    record = move_muscle(**hidden, creep_n_per_m=creep_n_per_m)
    found = guess_numbers([record], "muscle", PAPER)
    guessed = {name: found[name].value for name in FRICTIONS if name in found}
    assert guessed == pytest.approx(named, rel=0.2)
    assert found["stiffness_n_per_m"].value == pytest.approx(1500.0, rel=0.2)
    assert found["external_load.force_n"].value == pytest.approx(40.0, rel=0.33)
    mu_k = hidden.get("mu_k_per_m", 55.3)
    assert found["kinetic_friction_per_m"].value == pytest.approx(mu_k, rel=0.2, abs=8.0)


def test_dry_friction_that_nearly_follows_the_paper_s_angle_is_friction_of_the_braid():
    """The lever of Eq. 5 grows over the stroke; that of `sin(theta)` in it falls by 6 % more."""
    record = move_muscle(1.0, -1.0, falls_per_m=1.5, creep_n_per_m=1200.0)
    found = guess_numbers([record], "muscle", PAPER)
    assert {name for name in FRICTIONS if name in found} == {BACK, DRAG}


def test_of_a_muscle_that_does_not_move_no_mechanics_are_guessed():
    still = replace(move_muscle(1.0, -1.0), position_m=np.zeros(len(T_S)))
    assert {*guess_numbers([still], "muscle", PAPER)} == {"tank_pressure_pa"}


def test_a_braid_that_does_not_rub_gets_no_other_muscle_s_friction() -> None:
    muscle, t_s = LiftingMuscle(), np.arange(0.0, 12.0, 1e-3)
    position_m, pressure_pa = muscle.simulate(t_s, excite(t_s) - 1.0)
    lifted = Record("lifted", t_s, position_m=position_m, pressure_pa=pressure_pa)
    found = guess_numbers([lifted], "muscle", values_of(muscle.plant()))
    assert found["kinetic_friction_per_m"].value < 0.3 * PAPER["kinetic_friction_per_m"]
    assert found["external_load.force_n"].value == pytest.approx(muscle.preload_n, rel=0.1)


def fill_vessel(gain_m2_per_v: float, volume_m3: float, tank_pa: float) -> Record:
    """Return a vessel behind a valve, with the orifice's flow written out (ISO 6358's limit)."""
    air_j_per_kg, gamma = 287.1 * 293.0, 1.4

    def psi(up_pa: float, down_pa: float) -> float:
        r = max(down_pa / up_pa, (2.0 / (gamma + 1.0)) ** (gamma / (gamma - 1.0)))
        grows = 2.0 * gamma / ((gamma - 1.0) * air_j_per_kg)
        return up_pa * float(np.sqrt(grows * (r ** (2.0 / gamma) - r ** ((gamma + 1.0) / gamma))))

    def command_v(t: float) -> float:
        return 2.0 if t % 2.0 < 1.0 else -2.0

    def rate(u: float, pressure_pa: float) -> float:
        flow = u * (psi(tank_pa, pressure_pa) if u > 0.0 else psi(pressure_pa, 101.3e3))
        return air_j_per_kg * gain_m2_per_v * flow / volume_m3

    pressures, now_pa = [], 101.3e3
    for t in T_S:
        pressures.append(now_pa)
        half_pa = now_pa + 0.5 * PERIOD_S * rate(command_v(t), now_pa)
        now_pa += PERIOD_S * rate(command_v(t), half_pa)
        now_pa = min(max(now_pa, 101.4e3), tank_pa - 100.0)
    return Record(
        "vessel", T_S, valve_v=np.array([*map(command_v, T_S)]), pressure_pa=np.array(pressures)
    )


@pytest.mark.parametrize("gain", [2e-7, 6e-8])
def test_the_gain_of_a_valve_is_guessed_within_a_third_and_the_supply_where_it_was_reached(gain):
    record = fill_vessel(gain, 2e-3, 600e3)
    values = {**PAPER, "temperature_k": 293.0, "chamber_volume_m3": 2e-3}
    found = guess_numbers([record], "chamber", values)
    assert found["valve_gain_m2_per_v"].value == pytest.approx(gain, rel=0.33)
    assert found["tank_pressure_pa"].value >= 0.99 * np.max(record.pressure_pa)


def test_without_a_pressure_nothing_of_the_air_is_guessed():
    record = Record("still", T_S, valve_v=np.sin(T_S), position_m=1e-3 * np.sin(T_S))
    assert "valve_gain_m2_per_v" not in guess_numbers([record], "muscle", PAPER)


def test_a_stated_number_far_from_what_the_records_show_is_doubted_by_name():
    record = move_axis(4.0, 60.0, 900.0, 6.0)
    stated = {"mass_kg": 4.0, "damping_n_s_per_m": 20.0, "stiffness_n_per_m": 900.0}
    for name, factor, doubted in (
        ("mass_kg", 1000.0, True),
        ("mass_kg", 1e-3, True),
        ("stiffness_n_per_m", 5.0, False),
    ):
        parameters = {**stated, name: factor * stated[name]}
        plant = PlantSettings.model_validate({"actuator": "direct", "parameters": parameters})
        told = [*doubt_numbers([record], plant)]
        assert [line.split(" is stated")[0] for line in told] == [name] * doubted
    no_spring = PlantSettings.model_validate(
        {"actuator": "direct", "parameters": {**stated, "stiffness_n_per_m": 0.0}}
    )
    assert [*doubt_numbers([record], no_spring)] == []
