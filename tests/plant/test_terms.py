"""Terms in the plant: each operator, each location, and the plant file that states them."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from pamctl.plant.drive import drive_coupled, drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters, settings_of, values_of
from pamctl.plant.paper import force_area_m2
from pamctl.plant.parameters import parameters_of
from pamctl.plant.terms import (
    DRIVERS,
    OPERATORS,
    REFERENCES,
    PlantTerm,
    TermMemory,
    follow_value,
    shape_of,
)

TICK_S = 1e-3
TIMES_S = np.arange(1500) * TICK_S
COMMAND_V = np.where(
    TIMES_S < 0.1, -1.0, 2.0 * np.sin(9.0 * TIMES_S) + np.sign(np.sin(4.0 * TIMES_S))
)
PRESSURE_PA = 101.3e3 + 120e3 * (1.0 - np.cos(7.0 * TIMES_S))


def flat(location: str, operator: str, driver: str, **numbers: float) -> dict[str, float]:
    """Return a term's numbers by flat name."""
    chosen = {"operator": OPERATORS.index(operator), "driver": DRIVERS.index(driver), **numbers}
    return {f"{location}_term.{name}": float(value) for name, value in chosen.items()}


# --- operators, against numpy and closed forms ----------------------------------------------------

WAY_M = 0.01 * np.sin(5.0 * TIMES_S)
STEPS_S = np.full(len(TIMES_S) - 1, TICK_S)


def trace(operator: str, driver: str = "position", **numbers: float) -> np.ndarray:
    term = PlantTerm(1.0, 0.0, OPERATORS.index(operator), DRIVERS.index(driver), **numbers)
    return trace_shape(term)


def trace_shape(term: PlantTerm, slower: float = 1.0) -> np.ndarray:
    memory, begin, shape = TermMemory(), WAY_M[0], []
    for end, step_s in zip(WAY_M, [STEPS_S[0], *STEPS_S], strict=False):
        memory = follow_value(term, memory, begin, end, slower * step_s)
        shape.append(shape_of(term, end, memory))
        begin = end
    return np.array(shape)


def test_a_static_operator_is_its_formula():
    q = WAY_M / REFERENCES["position"]
    np.testing.assert_allclose(trace("constant"), 1.0)
    np.testing.assert_allclose(trace("gain"), q)
    np.testing.assert_allclose(trace("beyond", inner=4e-3), np.maximum(q - 0.4, 0.0))
    np.testing.assert_allclose(trace("dead_zone", inner=4e-3), -np.clip(q, -0.4, 0.4))
    np.testing.assert_allclose(trace("saturation", inner=4e-3), np.clip(q, -0.4, 0.4) - q)
    wave = np.sin(2.0 * np.pi * WAY_M / 3e-3 + 0.4)
    np.testing.assert_allclose(trace("wave", inner=3e-3, phase=0.4), wave)
    knots = [0.5, -1.0, 2.0, 0.0, 1.0]
    named = {f"knot_{k}": value for k, value in enumerate(knots, 1)}
    curve = np.interp(WAY_M, np.linspace(-8e-3, 6e-3, 5), knots)
    np.testing.assert_allclose(trace("curve", low=-8e-3, high=6e-3, **named), curve, atol=1e-12)


def test_a_lag_solves_its_differential_equation():
    solved = solve_ivp(
        lambda t, z: (np.interp(t, TIMES_S, WAY_M) - z) / 0.1, (0.0, TIMES_S[-1]), [WAY_M[0]],
        t_eval=TIMES_S, rtol=1e-9, atol=1e-12, max_step=TICK_S,
    )  # fmt: skip
    np.testing.assert_allclose(trace("lag", inner=0.1), (solved.y[0] - WAY_M) / 0.01, atol=1e-6)


def test_a_hysteresis_remembers_its_last_reversal_whatever_the_rate():
    kept = trace("hysteresis", inner=2e-3)
    first = int(np.argmax(WAY_M))
    np.testing.assert_allclose(
        kept[: first + 1], 1.0 - np.exp(-WAY_M[: first + 1] / 2e-3), atol=1e-9
    )
    second = first + int(np.argmin(WAY_M[first:]))
    back_m = WAY_M[first] - WAY_M[first : second + 1]
    expected = -1.0 + (kept[first] + 1.0) * np.exp(-back_m / 2e-3)
    np.testing.assert_allclose(kept[first : second + 1], expected, atol=1e-9)
    slow = PlantTerm(1.0, 0.0, OPERATORS.index("hysteresis"), DRIVERS.index("position"), 2e-3)
    np.testing.assert_allclose(trace_shape(slow, 7.0), kept)


def test_a_slew_limit_bounds_the_rate_and_a_play_the_distance():
    slewed = WAY_M + 0.01 * trace("slew", inner=0.03)
    assert np.abs(np.diff(slewed)).max() <= 0.03 * TICK_S * (1.0 + 1e-9)
    played = WAY_M + 0.01 * trace("play", inner=2e-3)
    assert np.abs(played - WAY_M).max() <= 1e-3 * (1.0 + 1e-9)
    assert np.sum(np.diff(played) == 0.0) > 100


# --- locations, against effects of the catalogue, which have an independent solution --------------

SAME = {
    "null offset": (flat("command", "constant", "command", size=0.3), None),
    "dead band": (
        flat("command", "dead_zone", "command", size=1.0, inner=0.2),
        {"valve_deadband.fill_width_v": 0.2, "valve_deadband.exhaust_width_v": 0.2},
    ),
    "play": (
        flat("command", "play", "command", size=1.0, inner=0.3),
        {"valve_hysteresis.width_v": 0.3},
    ),
    "narrow exhaust": (
        flat("exhausting", "constant", "time", size=-0.2), {"valve_asymmetry.exhaust_gain": 0.8},
    ),
    "wider valve": (
        flat("opening", "constant", "time", size=0.1), {"valve_gain_m2_per_v": 1.1 * 1.03e-6},
    ),
    "higher supply": (
        flat("supply", "constant", "time", size=9e3), {"tank_pressure_pa": 441.3e3 + 9e3},
    ),
    "dead volume": (
        flat("volume", "constant", "position", size=4e-6), {"dead_volume.volume_m3": 4e-6},
    ),
    "load": (flat("force", "constant", "position", size=-3.0), {"external_load.force_n": 3.0}),
    "creep": (
        flat("force", "lag", "position", size=3.0, inner=0.4),
        {"creep.stiffness_n_per_m": 300.0, "creep.time_constant_s": 0.4},
    ),
    "stiffer": (
        flat("stiffness", "constant", "time", size=320.0), {"stiffness_n_per_m": 10000.0},
    ),
    "more damping": (
        flat("damping", "gain", "pressure", size=20.0), {"pressure_damping.per_pa": 2e-4},
    ),
    "more friction": (
        flat("braid_friction", "constant", "time", size=0.1),
        {"kinetic_friction_per_m": 1.1 * 55.3},
    ),
    "sensor's gain": (
        flat("pressure_sensor", "gain", "pressure", size=2e3), {"pressure_sensor_gain.gain": 1.02},
    ),
    "encoder's scale": (
        flat("encoder", "gain", "position", size=1e-4), {"encoder_scale.scale": 1.01},
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SAME)
def test_a_term_acts_as_the_effect_that_it_is_kin_to(case):
    term, effect = SAME[case]
    ours = drive_coupled(parameters_of(term), COMMAND_V, TICK_S)
    plain = drive_coupled(parameters_of({}), COMMAND_V, TICK_S)
    if effect is None:
        same = drive_coupled(parameters_of({}), COMMAND_V + 0.3, TICK_S)
    else:
        same = drive_coupled(parameters_of(effect), COMMAND_V, TICK_S)
    scale = np.array([[1e-6], [10.0]])
    moved = np.abs((np.array(plain)[:2] - np.array(same)[:2]) / scale).max()
    left = np.abs((np.array(ours)[:2] - np.array(same)[:2]) / scale).max()
    assert moved > 5.0
    assert left < max(0.01 * moved, 0.1)


def test_the_pulls_of_two_locations_are_those_of_equation_3():
    """A pull that is larger by a share, and a pressure that pulls more, give one force."""
    paper = parameters_of({}).paper
    share = drive_mechanics(
        parameters_of(flat("pull", "constant", "time", size=0.03)), PRESSURE_PA, TICK_S
    )
    steady_pa = np.full(len(TIMES_S), 301.3e3)
    more = flat("pressing", "constant", "time", size=0.03 * 200e3)
    pressing = drive_mechanics(parameters_of(more), steady_pa, TICK_S).position_m[-1]
    scaled = flat("pull", "constant", "time", size=0.03)
    pulling = drive_mechanics(parameters_of(scaled), steady_pa, TICK_S).position_m[-1]
    assert pressing == pytest.approx(pulling, abs=1e-9)
    assert (
        share.position_m.max()
        > drive_mechanics(parameters_of({}), PRESSURE_PA, TICK_S).position_m.max()
    )
    spring_n = paper.stiffness_n_per_m * pulling
    assert 1.03 * 200e3 * force_area_m2(paper, pulling) > spring_n


def test_a_reading_without_its_term_is_found_again():
    p = parameters_of(flat("pressure_sensor", "gain", "pressure", size=3e3))
    coupled = drive_coupled(p, COMMAND_V, TICK_S)
    alone = drive_mechanics(p, coupled.pressure_pa, TICK_S)
    paper = drive_mechanics(parameters_of({}), coupled.pressure_pa, TICK_S)
    wrong_m = np.abs(paper.position_m - coupled.position_m).max()
    assert np.abs(alone.position_m - coupled.position_m).max() < 0.05 * wrong_m


def test_the_pressure_block_alone_has_the_terms_of_the_coupled_plant():
    p = parameters_of(flat("supply", "wave", "time", size=6e3, inner=0.31, phase=0.5))
    coupled = drive_coupled(p, COMMAND_V, TICK_S)
    alone = drive_pressure(p, COMMAND_V, coupled.position_m, TICK_S)
    assert np.abs(alone.pressure_pa - coupled.pressure_pa).max() < 60.0


# --- the plant file -------------------------------------------------------------------------------

FORCE = {"operator": "hysteresis", "driver": "position", "size": 1.5, "inner": 1.5e-3}


def test_a_plant_file_keeps_its_terms():
    plant = PlantSettings.model_validate({"terms": {"force": FORCE}})
    assert settings_of(values_of(plant)) == plant
    written = plant.model_dump(mode="json", round_trip=True, exclude_none=True)
    assert written["terms"] == {"force": FORCE}
    assert PlantSettings.model_validate(written) == plant
    assert "terms" not in PlantSettings().model_dump(exclude_none=True)
    terms = plant_parameters(plant).terms
    assert terms is not None
    assert terms.mechanics.size == 1.5


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({"force": {**FORCE, "driver": "command"}}, "here it may be position, pressure"),
        ({"force": {**FORCE, "driver": "time"}}, "memory, which here is one of position or"),
        ({"force": {**FORCE, "inner": 0.0}}, "inner of a hysteresis must be greater than 0"),
        ({"force": FORCE, "pull": {**FORCE, "operator": "gain"}}, "which holds one term"),
        ({"forces": FORCE}, "Extra inputs"),
    ],
)
def test_a_wrong_term_is_refused_with_its_place(terms, message):
    with pytest.raises(ValidationError, match=message):
        PlantSettings.model_validate({"terms": terms})
