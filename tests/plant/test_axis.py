"""A mechanism of one axis moves as closed forms say, and needs the force that moved it."""

import math

import numpy as np
import pytest
from support.command_line import run_pamctl

import pamctl.log
from pamctl.plant.drive import drive_mechanics
from pamctl.plant.parameters import parameters_of, rest_state, vented_state
from pamctl.plant.required_force import required_force_n
from pamctl.plant.step import advance_plant

TICK_S = 1e-3
ATMOSPHERE_PA = 101.3e3
T_S = np.arange(3000) * TICK_S
FORCE_N = 60.0 * np.sin(2 * math.pi * 0.7 * T_S) + 25.0 * np.sin(2 * math.pi * 1.9 * T_S)
PRESSURE_PA = ATMOSPHERE_PA + 2e4 * (1.0 - np.cos(2 * math.pi * 0.5 * T_S))

CARRIAGE = {"actuator": 1.0, "mass_kg": 95.0, "damping_n_s_per_m": 200.0, "stiffness_n_per_m": 0.0}


def axis(**numbers: float) -> dict[str, float]:
    return CARRIAGE | {name.replace("__", "."): value for name, value in numbers.items()}


@pytest.mark.parametrize("damping", [0.0, 1e-9, 1e-3, 1.0, 200.0])
def test_a_free_mass_moves_as_the_closed_form_says(damping):
    """No spring, no friction: a constant force, with any damping down to none."""
    p = parameters_of(axis(mass_kg=2.0, damping_n_s_per_m=damping))
    moved = drive_mechanics(p, np.full(1001, ATMOSPHERE_PA), TICK_S, force_n=np.full(1001, 3.0))
    t = T_S[:1001]
    rate = damping / 2.0
    if rate < 1e-2:  # the series of the exponential
        expected_m = 1.5 * t**2 * (0.5 - rate * t / 6.0 + (rate * t) ** 2 / 24.0)
    else:
        expected_m = 1.5 / rate * (t - (1.0 - np.exp(-rate * t)) / rate)
    np.testing.assert_allclose(moved.position_m, expected_m, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("command_v", [3.0, -0.5])
def test_a_driven_axis_moves_as_the_closed_form_of_its_force_says(command_v):
    p = parameters_of(axis(mass_kg=2.0, damping_n_s_per_m=4.0, drive_n_per_v=20.0))
    state = vented_state(p)
    state = advance_plant(p, state, command_v, 1.5, 1e-3)
    rate, speed = 4.0 / 2.0, 20.0 * command_v / 4.0
    expected_m = speed * (1.5 - (1.0 - math.exp(-rate * 1.5)) / rate)
    assert state.position_m == pytest.approx(expected_m, rel=1e-9)
    assert state.pressure_pa == pytest.approx(ATMOSPHERE_PA, rel=1e-12)


def test_the_log_of_a_driven_axis_has_the_mean_force_around_each_sample(tmp_path):
    """The drive holds its force between two samples: this is what a load cell would show."""
    (tmp_path / "plant.yaml").write_text(
        "actuator: direct\ndrive_n_per_v: 20\n"
        "parameters: {mass_kg: 4, damping_n_s_per_m: 30, stiffness_n_per_m: 0}\n"
    )
    named = ["--plant", "plant.yaml", "--rig", "axis", "--controller", "pid"]
    motion = ["--experiment", "step", "--duration", "3", "--log", "run.mcap"]
    ran = run_pamctl("run", "--fast", "--quiet", *named, *motion, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    log = pamctl.log.read(tmp_path / "run.mcap")
    measured = pamctl.log.signals(log)
    assert measured.valve_v is not None
    assert measured.force_n is not None
    assert measured.force_n[0] == pytest.approx(10.0 * measured.valve_v[0])
    expected_n = 10.0 * (measured.valve_v[1:] + measured.valve_v[:-1])
    np.testing.assert_allclose(measured.force_n[1:], expected_n, rtol=1e-12)


def test_a_thrown_mass_stops_where_dry_friction_stops_it_and_stays():
    p = parameters_of(axis(mass_kg=2.0, damping_n_s_per_m=0.0, coulomb_friction__force_n=4.0))
    start = rest_state(p, 0.0, ATMOSPHERE_PA)._replace(velocity_m_per_s=0.5)
    flown = drive_mechanics(
        p, np.full(1001, ATMOSPHERE_PA), TICK_S, force_n=np.zeros(1001), start=start
    )
    np.testing.assert_allclose(flown.position_m[250:], 0.5 * 0.5**2 / 2.0, rtol=1e-9)
    assert (flown.velocity_m_per_s[251:] == 0.0).all()
    before = flown.velocity_m_per_s[:250]
    np.testing.assert_allclose(before, 0.5 - 2.0 * T_S[:250], atol=1e-12)


FORMS = {
    "friction": {
        "coulomb_friction__force_n": 20.0,
        "viscous_asymmetry__share": -0.18,
        "external_load__force_n": -3.0,
    },
    "piston": {
        "piston__area_m2": 5e-4,
        "pressure_friction__n_per_pa": 1e-4,
        "pressure_damping__per_pa": 1e-3,
        "coulomb_friction__force_n": 5.0,
    },
    "springs": {"stiffness_n_per_m": 800.0, "cubic_stiffness__n_per_m3": 5e4},
    "creep": {"creep__stiffness_n_per_m": 300.0, "creep__time_constant_s": 0.4},
    "stribeck": {"coulomb_friction__force_n": 15.0, "stribeck__rise": 0.4,
                 "stribeck__speed_m_per_s": 0.05},
    **{
        f"bristles-{form:g}": {
            "coulomb_friction__force_n": 20.0,
            "presliding__compliance_m_per_n": 2e-5,
            "presliding__form": form,
            "presliding__bristle_damping_n_s_per_m": 30.0,
            "presliding__third_over_first": 4.0,
        }
        for form in (0.0, 1.0, 2.0, 3.0)
    },
}  # fmt: skip


@pytest.mark.parametrize("name", FORMS)
def test_the_required_force_is_the_force_that_made_the_motion(name):
    """The simulation under a force, read backwards: both are made of the same kernels."""
    p = parameters_of(axis(**FORMS[name]))
    start = rest_state(p, 0.0, float(PRESSURE_PA[0]))
    moved = drive_mechanics(p, PRESSURE_PA, TICK_S, force_n=FORCE_N, start=start, steps=8)
    v = moved.velocity_m_per_s
    needed_n = required_force_n(
        p, T_S, moved.true_position_m, v, np.gradient(v, TICK_S), PRESSURE_PA
    )
    sliding = np.abs(v) > 5e-3
    sliding[:2] = sliding[-2:] = False
    assert sliding.sum() > 1000
    error_n = np.abs(needed_n - FORCE_N)[sliding]
    assert np.median(error_n) < 0.01
    assert np.quantile(error_n, 0.98) < 0.3
    plain_n = required_force_n(
        parameters_of(CARRIAGE), T_S, moved.true_position_m, v, np.gradient(v, TICK_S), PRESSURE_PA
    )
    assert np.median(np.abs(plain_n - FORCE_N)[sliding]) > 1.0


def test_at_rest_the_middle_of_the_band_is_needed_and_slowly_less_than_in_motion():
    p = parameters_of(
        axis(coulomb_friction__force_n=20.0, friction_asymmetry__share=0.1, damping_n_s_per_m=0.0)
    )
    v = np.array([-1.0, -1e-3, 0.0, 1e-3, 1.0])
    still = np.zeros(5)
    blended = required_force_n(p, T_S[:5], still, v, still, rest_speed_m_per_s=2e-3)
    np.testing.assert_allclose(blended, [-18.0, -8.0, 2.0, 12.0, 22.0])
    np.testing.assert_allclose(
        required_force_n(p, T_S[:5], still, v, still), [-18.0, -18.0, 2.0, 22.0, 22.0]
    )


def test_a_column_that_does_not_fit_is_refused():
    p, still = parameters_of(CARRIAGE), np.zeros(5)
    with pytest.raises(ValueError, match=r"velocity_m_per_s: shape \(4,\), where t_s has 5"):
        required_force_n(p, T_S[:5], still, still[:4], still)
    broken = np.array([0.0, 0.0, math.nan, 0.0, 0.0])
    with pytest.raises(ValueError, match="pressure_pa: sample 2 is no number"):
        required_force_n(p, T_S[:5], still, still, still, broken)


def test_a_muscle_that_moves_by_itself_needs_no_force_from_outside():
    """The muscle's own pull makes its motion; a load of 5 N has to come from somewhere."""
    muscle = {"coulomb_friction.force_n": 3.0}
    moved = drive_mechanics(parameters_of(muscle), PRESSURE_PA, TICK_S, steps=8)
    v = moved.velocity_m_per_s
    a = np.gradient(v, TICK_S)
    sliding = np.abs(v) > 1e-3
    for load_n in (0.0, 5.0):
        p = parameters_of(muscle | {"external_load.force_n": load_n})
        needed_n = required_force_n(p, T_S, moved.position_m, v, a, PRESSURE_PA)
        assert np.median(np.abs(needed_n - load_n)[sliding]) < 0.02
