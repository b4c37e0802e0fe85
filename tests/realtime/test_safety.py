"""What reaches the valve: whatever is commanded, measured or late."""

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from support.paper_equations import pressure_rate
from support.runs import COUNT_M, run_settings

from hal.calibration import Zero, calibration
from hal.rig import RawSample
from hal.sim import sensed_counts, sensed_pressure_v, sensor_chain
from pamctl.control.course import Course, make_valve_reference
from pamctl.control.experiment import plan_experiment
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import PlantParameters, PlantState, vented_state
from pamctl.plant.step import advance_plant
from pamctl.realtime.tick import first_state, measure, step
from pamctl.safety import (
    COMMAND_NOT_FINITE,
    ENCODER_JUMP,
    ENVELOPE,
    INITIAL_SAFETY_STATE,
    MEASUREMENT_NOT_FINITE,
    OVERRUNS,
    PINNED,
    PRESSURE_LIMIT,
    PRESSURE_TOO_HIGH,
    PRESSURE_TOO_LOW,
    SENSOR_RANGE,
    SLEW,
    STALE_SAMPLE,
    STROKE_LIMIT,
    TRACKING_ERROR,
    VERDICTS,
    Limits,
    LimitSettings,
    SafetyState,
    admit,
    convert_limits,
    explain_verdicts,
)
from pamctl.settings.build import build_tick_setup
from pamctl.signals import Command, Decision, Estimate, Measurement, Phase, Reference, Timing

NAN = math.nan
CLIPS = ENVELOPE | SLEW
MODEL = plant_parameters(PlantSettings())
SAFE_V = -4.5
P_ATM = 101.3e3


def limited(**changes: float) -> Limits:
    return convert_limits(
        LimitSettings(**changes), safe_valve_v=SAFE_V, count_m=COUNT_M, model=MODEL.paper
    )


class Seen(NamedTuple):
    """One tick in safety's eyes; the defaults are a quiet muscle under a law."""

    command_v: float = 0.0
    position_m: float = 0.010
    pressure_pa: float = 200e3
    sensor_v: float = 0.8
    error_m: float = 0.0
    dt_s: float = 1e-3
    missed: int = 0
    phase: int = Phase.TRACK
    open_loop: bool = False


def admitted(lim: Limits, ticks: Iterable[Seen]) -> list[tuple[Decision, SafetyState]]:
    state, found = INITIAL_SAFETY_STATE, []
    for n, tick in enumerate(ticks):
        decision, state = admit(
            lim,
            state,
            RawSample(tick.sensor_v, 0, 0, 0),
            Measurement(tick.position_m, tick.pressure_pa),
            Reference(tick.phase, 0, 0, 0, 0, tick.command_v if tick.open_loop else NAN),
            Estimate(tick.position_m, tick.pressure_pa, tick.error_m, 0, 0),
            Command(tick.command_v, 0, 0, 0, False),
            Timing(n, n * 1e-3, tick.dt_s, 0, tick.missed),
        )
        found.append((decision, state))
    return found


def decisions(lim: Limits, *ticks: Seen) -> list[Decision]:
    return [decision for decision, _ in admitted(lim, ticks)]


wild = st.floats() | st.sampled_from([NAN, math.inf, -math.inf, 0.0, 0.2, 1e300, -1e300])
usual = {
    "command_v": st.floats(-12, 12) | wild,
    "position_m": st.just(0.01) | st.floats(-0.003, 0.031) | wild,
    "pressure_pa": st.just(200e3) | st.floats(9e4, 6e5) | wild,
    "sensor_v": st.just(0.8) | st.floats(0, 5) | wild,
    "error_m": st.floats(-5e-3, 5e-3) | wild,
    "dt_s": st.just(1e-3) | st.floats(1e-4, 0.06) | wild,
    "missed": st.just(0) | st.integers(0, 200),
    "phase": st.sampled_from(Phase),
    "open_loop": st.booleans(),
}
anything = st.builds(Seen, **usual)
calm = st.builds(
    Seen,
    command_v=st.floats(-12, 12),
    position_m=st.floats(0.009, 0.011),
    pressure_pa=st.floats(190e3, 210e3),
    dt_s=st.floats(5e-4, 0.049),
    open_loop=st.booleans(),
)
sequences = st.lists(calm | anything, max_size=40) | st.lists(calm, max_size=40)
envelopes = st.sampled_from([5.0, 3.0])
slews = st.sampled_from([10_000.0, 100.0, 1.0])


@settings(max_examples=80)
@given(sequences)
def test_a_pinned_valve_hears_nothing_but_the_safe_command(ticks):
    for decision, _ in admitted(limited()._replace(pinned=True), ticks):
        assert decision.valve_v == SAFE_V
        assert decision.tripped == (decision.verdicts != PINNED)
        assert not decision.verdicts & (CLIPS | TRACKING_ERROR)


@settings(max_examples=200)
@given(sequences, envelopes, slews)
def test_nothing_gets_past_the_envelope_the_slew_limit_and_the_trips(ticks, envelope, slew):
    lim = limited(command_v=envelope, slew_v_per_s=slew, pressure_model_pa=5e4)
    last_v, tripped = NAN, 0
    for tick, (decision, state) in zip(ticks, admitted(lim, ticks), strict=True):
        valve_v, trips = decision.valve_v, decision.verdicts & ~CLIPS
        assert trips & tripped == tripped, "a trip is latched"
        assert decision.tripped == bool(trips) == bool(state.tripped)
        assert all(bit in VERDICTS for bit in bits(decision.verdicts))
        if decision.tripped:
            assert valve_v == SAFE_V
            assert not decision.verdicts & CLIPS
        else:
            assert abs(valve_v) <= envelope
            limit_v = slew * tick.dt_s
            within_reach = tick.open_loop or math.isnan(last_v)
            assert within_reach or abs(valve_v - last_v) <= limit_v * (1 + 1e-9) + 1e-12
            clipped = valve_v != tick.command_v
            assert clipped == bool(decision.verdicts & CLIPS)
            # Between what it was and what was asked for, never anywhere else.
            wanted = max(-envelope, min(envelope, tick.command_v))
            start = wanted if within_reach else last_v
            assert min(start, wanted) - 1e-12 <= valve_v <= max(start, wanted) + 1e-12
        last_v, tripped = valve_v, trips


def bits(verdicts: int) -> list[int]:
    return [1 << n for n in range(64) if verdicts >> n & 1]


# --- clips -----------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("dt_s", [1e-3, 4e-3])
def test_a_law_changes_the_valve_no_faster_than_the_slew_limit(sign, dt_s):
    lim = limited(slew_v_per_s=100.0)
    reach_v = 100.0 * dt_s
    _, slow, fast = decisions(
        lim, Seen(0.0), Seen(sign * 0.999 * reach_v, dt_s=dt_s), Seen(sign * 3.0, dt_s=dt_s)
    )
    assert slow == Decision(sign * 0.999 * reach_v, 0, False)
    assert fast.verdicts == SLEW
    assert fast.valve_v == pytest.approx(sign * 1.999 * reach_v)


# --- trips -----------------------------------------------------------------------------


def held_ticks(tick: Seen, count: int) -> list[Seen]:
    return [Seen()] * 5 + [tick] * count


AT_ONCE = {
    "command NaN": (COMMAND_NOT_FINITE, Seen(), Seen(command_v=NAN)),
    "command inf": (COMMAND_NOT_FINITE, Seen(), Seen(command_v=math.inf)),
    "pressure NaN": (MEASUREMENT_NOT_FINITE, Seen(), Seen(pressure_pa=NAN)),
    "position NaN": (MEASUREMENT_NOT_FINITE | STROKE_LIMIT, Seen(), Seen(position_m=NAN)),
    "pressure": (PRESSURE_LIMIT, Seen(pressure_pa=250e3), Seen(pressure_pa=250.001e3)),
    "stroke up": (
        STROKE_LIMIT,
        Seen(position_m=0.0101, dt_s=0.01),
        Seen(position_m=0.01010001, dt_s=0.01),
    ),
    "stroke down": (
        STROKE_LIMIT,
        Seen(position_m=0.0099, dt_s=0.01),
        Seen(position_m=0.00989999, dt_s=0.01),
    ),
    "encoder jump up": (
        ENCODER_JUMP,
        Seen(position_m=0.010 + 0.02e-3 + 3.99 * COUNT_M),
        Seen(position_m=0.010 + 0.02e-3 + 4.01 * COUNT_M),
    ),
    "encoder jump down": (
        ENCODER_JUMP,
        Seen(position_m=0.010 - 0.02e-3 - 3.99 * COUNT_M),
        Seen(position_m=0.010 - 0.02e-3 - 4.01 * COUNT_M),
    ),
    "sample age": (STALE_SAMPLE, Seen(dt_s=0.05), Seen(dt_s=0.050001)),
    "no time passed": (STALE_SAMPLE, Seen(dt_s=1e-9), Seen(dt_s=0.0)),
    "time runs back": (STALE_SAMPLE | ENCODER_JUMP, Seen(dt_s=1e-9), Seen(dt_s=-1e-3)),
    "time is no number": (STALE_SAMPLE, Seen(), Seen(dt_s=NAN)),
    "overruns": (OVERRUNS, Seen(missed=100), Seen(missed=101)),
}
AT_ONCE_LIMITS = limited(pressure_pa=250e3, speed_mm_per_s=20.0)._replace(
    stroke_low_m=9.9e-3, stroke_high_m=10.1e-3
)


@pytest.mark.parametrize("case", AT_ONCE)
def test_a_rule_without_patience_trips_at_its_limit_and_not_below(case):
    bit, below, beyond = AT_ONCE[case]
    allowed = decisions(AT_ONCE_LIMITS, Seen(), below)[-1]
    tripped = decisions(AT_ONCE_LIMITS, Seen(), beyond)[-1]
    assert allowed == Decision(0.0, 0, False)
    assert tripped == Decision(SAFE_V, bit, True)


def test_the_first_tick_has_no_previous_position_to_jump_from():
    assert decisions(limited(), Seen(position_m=0.025))[0].verdicts == 0


def test_an_encoder_may_move_as_far_as_the_time_it_had():
    far = Seen(position_m=0.010 + 2.0 * 5e-3, dt_s=5e-3)
    assert decisions(limited(), Seen(), far)[-1].verdicts == 0
    assert decisions(limited(), Seen(), far._replace(dt_s=4e-3))[-1].verdicts == ENCODER_JUMP


PATIENT = {
    "broken wire": (SENSOR_RANGE, Seen(sensor_v=0.1), Seen(sensor_v=0.0999)),
    "short circuit": (SENSOR_RANGE, Seen(sensor_v=4.8), Seen(sensor_v=4.8001)),
    "error up": (TRACKING_ERROR, Seen(error_m=4e-3), Seen(error_m=4.0001e-3)),
    "error down": (TRACKING_ERROR, Seen(error_m=-4e-3), Seen(error_m=-4.0001e-3)),
}


@pytest.mark.parametrize("case", PATIENT)
@pytest.mark.parametrize("dt_s", [1e-3, 3e-3])
def test_a_rule_with_patience_trips_when_it_is_over(case, dt_s):
    bit, below, beyond = PATIENT[case]
    assert decisions(limited(), *held_ticks(below, 200))[-1].verdicts == 0
    found = decisions(limited(), *held_ticks(beyond._replace(dt_s=dt_s), 30))
    broken_s = next(n for n, d in enumerate(found[5:], 1) if d.tripped) * dt_s
    assert 0.02 <= broken_s <= 0.02 + dt_s * 1.001
    assert found[-1] == Decision(SAFE_V, bit, True)


def test_without_patience_a_broken_wire_trips_in_its_first_tick():
    lim = limited(patience_s=0.0)
    assert decisions(lim, Seen(), Seen(sensor_v=0.0))[-1].verdicts == SENSOR_RANGE


def test_every_verdict_has_its_own_bit_and_words():
    assert explain_verdicts(0) == []
    for bit, meaning in VERDICTS.items():
        assert bits(bit) == [bit]
        assert explain_verdicts(bit) == [meaning]
    assert explain_verdicts(sum(VERDICTS)) == list(VERDICTS.values())
    assert len(set(VERDICTS.values())) == len(VERDICTS) == 14


def test_limits_that_exclude_each_other_are_refused():
    with pytest.raises(ValueError, match="below sensor_high_v"):
        LimitSettings(sensor_low_v=2.0, sensor_high_v=2.0)


# --- the pressure must follow the command ----------------------------------------------

FULL = PlantState(0.0236, 0.0, 441.3e3)
VENTED = vented_state(MODEL)


class Driven(NamedTuple):
    decision: Decision
    t_s: float
    """Of the last tick: of the trip, if there was one."""
    worst_pa: float
    """How far the measured pressure ever was from the model's."""


def driven(
    command_at: Callable[[float], float],
    seconds: float,
    *,
    plant: PlantParameters = MODEL,
    start: PlantState = VENTED,
    really: Callable[[float, float], float] = lambda t_s, command_v: command_v,
    delay: int = 0,
    **changes: float,
) -> Driven:
    """Drive the plant open loop through the simulated sensors and the safety stage.

    `really` says what the valve does when it is told something.
    """
    run = run_settings()
    cal = calibration(run.rig.calibration)
    chain = sensor_chain(run.rig.sim, run.rig.calibration)
    lim = convert_limits(
        LimitSettings(**changes), safe_valve_v=-5.0, count_m=COUNT_M, model=MODEL.paper
    )
    muscle, safety, written, worst = start, INITIAL_SAFETY_STATE, [0.0] * (delay + 1), 0.0
    noise = (0.5 * math.sin(1e3 * n * n) for n in range(10**9))
    for tick in range(round(seconds * 1e3)):
        t_s = tick * 1e-3
        raw = RawSample(
            sensed_pressure_v(chain, muscle.pressure_pa, next(noise)),
            sensed_counts(chain, muscle.position_m),
            0,
            0,
        )
        measured = measure(cal, chain.zero, raw)
        asked = make_valve_reference(Phase.OPEN_LOOP, command_at(t_s))
        command = Command(asked.reference_valve_v, NAN, 0, 0, False)
        estimated = Estimate(measured.position_m, measured.pressure_pa, NAN, NAN, NAN)
        timing = Timing(tick, t_s, 1e-3, 0, 0)
        decision, safety = admit(lim, safety, raw, measured, asked, estimated, command, timing)
        worst = max(worst, abs(measured.pressure_pa - safety.model_pressure_pa))
        if decision.tripped:
            break
        written.append(decision.valve_v)
        valve_v = really(t_s, written[-1 - delay])
        muscle = advance_plant(plant, muscle, valve_v, 1e-3, 0.5e-3)
    return Driven(decision, t_s, worst)


def square(frequency_hz: float) -> Callable[[float], float]:
    return lambda t_s: 5.0 if (t_s * frequency_hz) % 1.0 < 0.5 else -5.0


STUCK_FROM_S = 0.3
STUCK = {
    "closed, told to fill": (PRESSURE_TOO_LOW, VENTED, 0.0, 5.0, 0.0),
    "closed, told to exhaust": (PRESSURE_TOO_HIGH, FULL, 0.0, -5.0, 0.0),
    "open to the tank, told to exhaust": (PRESSURE_TOO_HIGH, FULL, 5.0, -5.0, 5.0),
    "open to the tank, told to hold": (PRESSURE_TOO_HIGH, VENTED, 0.0, 0.0, 5.0),
    "open to the air, told to fill": (PRESSURE_TOO_LOW, VENTED, -5.0, 5.0, -5.0),
    "open to the air, told to hold": (PRESSURE_TOO_LOW, FULL, 0.0, 0.0, -5.0),
    "reversed, told to fill": (PRESSURE_TOO_LOW, VENTED, -5.0, 5.0, -5.0),
}


@pytest.mark.parametrize("case", STUCK)
@pytest.mark.parametrize("delay", [0, 1])
def test_a_stuck_valve_is_noticed_within_a_fifth_of_a_second(case, delay):
    bit, start, before_v, then_v, stuck_v = STUCK[case]
    found = driven(
        lambda t_s: before_v if t_s < STUCK_FROM_S else then_v,
        1.0,
        start=start,
        really=lambda t_s, command_v: command_v if t_s < STUCK_FROM_S else stuck_v,
        delay=delay,
    )
    assert found.decision.verdicts == bit
    assert STUCK_FROM_S < found.t_s < STUCK_FROM_S + 0.2


def test_a_burst_hose_is_noticed_while_filling():
    """Half of the valve's flow escapes: the muscle never gets beyond some 200 kPa."""
    found = driven(square(0.25), 1.0, really=lambda t_s, command_v: 0.1 * command_v)
    assert found.decision.verdicts == PRESSURE_TOO_LOW
    assert found.t_s < 0.2


@pytest.mark.parametrize("late_s", [10e-3, 25e-3, 45e-3])
@pytest.mark.parametrize("command_v", [5.0, 2.0, -5.0])
def test_a_tick_that_comes_late_while_the_muscle_fills_or_empties_trips_nothing(command_v, late_s):
    """The measured pressure is that of the paper's equations, solved by scipy."""
    instants_s = np.cumsum([0.0, 1e-3, 1e-3, late_s, 1e-3, late_s, *[1e-3] * 40])
    start_pa = 120e3 if command_v > 0.0 else 420e3
    solved = solve_ivp(
        lambda t_s, pressure_pa: [pressure_rate(command_v, 0.010, 0.0, pressure_pa[0])],
        (0.0, instants_s[-1]),
        [start_pa],
        t_eval=instants_s,
        rtol=1e-8,
        max_step=1e-4,
    )
    ticks = [
        Seen(command_v, pressure_pa=pressure_pa, dt_s=dt_s, open_loop=True)
        for pressure_pa, dt_s in zip(solved.y[0], [1e-3, *np.diff(instants_s)], strict=True)
    ]
    found = admitted(limited(), ticks)
    assert {decision.verdicts for decision, _ in found} == {0}
    model_pa = [state.model_pressure_pa for _, state in found]
    assert np.max(np.abs(model_pa[:-1] - solved.y[0][:-1])) < 20e3


def plant_with(**changes: Any) -> PlantParameters:
    effects = {"valve_spool": changes.pop("spool")} if "spool" in changes else {}
    base = dict(PlantSettings().parameters)
    for name, share in changes.items():
        if name == "supply":  # gauge
            base["tank_pressure_pa"] = P_ATM + share * (base["tank_pressure_pa"] - P_ATM)
        else:
            base[name] *= share
    return plant_parameters(PlantSettings.model_validate({"parameters": base, "effects": effects}))


SPOOL_109_HZ = {"time_constant_s": 1.0 / (2 * math.pi * 109.0), "damping_ratio": 0.7}
NEAR = {
    "paper": {},
    "109 Hz valve": {"spool": SPOOL_109_HZ},
    "60 Hz valve": {"spool": {"time_constant_s": 1 / (2 * math.pi * 60), "damping_ratio": 0.7}},
    **{
        f"{name} {share:+.0%}": {name: 1 + share}
        for name in ("valve_gain_m2_per_v", "stiffness_n_per_m", "kinetic_friction_per_m")
        for share in (-0.2, 0.2)
    },
    "supply -20%": {"supply": 0.8},
    "all of it": {
        "valve_gain_m2_per_v": 0.8,
        "stiffness_n_per_m": 0.8,
        "kinetic_friction_per_m": 1.2,
        "supply": 0.9,
        "spool": SPOOL_109_HZ,
    },
}


@pytest.mark.parametrize("name", NEAR)
def test_squares_at_full_scale_never_trip_a_muscle_near_the_model(name):
    plant = plant_with(**NEAR[name])
    for frequency_hz, delay in ((0.25, 1), (0.5, 0), (1.0, 1), (2.0, 0), (2.0, 1)):
        found = driven(square(frequency_hz), max(1.0, 1.0 / frequency_hz), plant=plant, delay=delay)
        assert not found.decision.tripped, explain_verdicts(found.decision.verdicts)
        assert found.worst_pa > 1e3  # the model was put to the test at all


@pytest.mark.parametrize("name", ["paper", "60 Hz valve", "stiffness_n_per_m -20%", "all of it"])
def test_tracking_never_trips_a_muscle_near_the_model(name):
    """Whatever the law makes of such a muscle: the pressure still follows its command."""
    run = run_settings(plant="paper")
    setup = build_tick_setup(run)
    setup = setup._replace(limits=setup.limits._replace(tracking_error_m=1.0))
    chain = sensor_chain(run.rig.sim, run.rig.calibration)
    plant = plant_with(**NEAR[name])
    state, muscle = first_state(setup, Zero(chain.zero.sensor_zero_v, 1000.0)), VENTED
    course = Course(
        [
            s._replace(duration_s=0.2 * s.duration_s)
            for s in plan_experiment(run.experiment).segments
        ]
    )
    for tick in range(2500):
        raw = RawSample(
            sensed_pressure_v(chain, muscle.pressure_pa, 0.0),
            sensed_counts(chain, muscle.position_m),
            0,
            0,
        )
        reference = course.at(tick * 1e-3)
        assert reference is not None
        state, decision = step(setup, state, raw, reference, Timing(tick, 0, 1e-3, 0, 0))
        assert not decision.tripped, explain_verdicts(decision.verdicts)
        muscle = advance_plant(plant, muscle, decision.valve_v, 1e-3, 0.5e-3)
    assert muscle.position_m > 5e-3


def test_a_model_pressure_from_nowhere_cannot_raise():
    """Where the encoder says there is no muscle left, the other rules decide."""
    away = Seen(
        position_m=MODEL.paper.rest_length_m, phase=Phase.HOMING, open_loop=True, command_v=5.0
    )
    assert decisions(limited(), *[away] * 5)[-1] == Decision(5.0, 0, False)
