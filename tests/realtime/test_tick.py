"""The tick: pure, complete on record, frozen without loss, and quick."""

import math
from itertools import count
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.runs import run_settings

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.control.course import make_valve_reference
from pamctl.kernel.calls import PlainCall
from pamctl.processes import loop_main
from pamctl.realtime import run_ticks
from pamctl.realtime.tick import (
    TickSetup,
    TickState,
    first_state,
    freeze_state,
    keyframe_fields,
    step,
    thaw_state,
)
from pamctl.realtime.tick_runner import (
    BUSY_SHARE,
    LIVE_FACTOR,
    TickCost,
    TickRunner,
    rehearse_tick_s,
)
from pamctl.safety import SENSOR_RANGE
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import resolve
from pamctl.signals import TICK_FIELDS, Decision, Phase, Reference, TickRecord, Timing

NAN = math.nan
ZERO = Zero(0.2, 1000.0)
SETUP = build_tick_setup(run_settings())


def sample(tick: int, counts: int = 3016, volts: float = 0.9) -> RawSample:
    return RawSample(volts, counts, tick * 1_000_000, tick * 1_000_000)


def timing(tick: int, dt_s: float = 1e-3) -> Timing:
    return Timing(tick, tick * 1e-3, dt_s, 0.0, 0)


def track(position_m: float = 6.4e-3) -> Reference:
    return Reference(Phase.TRACK, position_m, 0.0, 0.0, 0.0, NAN)


def moving(tick: int) -> RawSample:
    return sample(tick, 3016 + round(40 * math.sin(0.05 * tick)), 0.9 + 0.01 * math.cos(0.3 * tick))


def run(
    ticks: range, state: TickState | None = None, setup: TickSetup = SETUP
) -> tuple[TickState, list[Decision]]:
    state = first_state(setup, ZERO) if state is None else state
    found = []
    for tick in ticks:
        state, decision = step(setup, state, moving(tick), track(), timing(tick))
        found.append(decision)
    return state, found


@pytest.mark.parametrize("controller", ["paper-table3-qsmc", "smc", "pid"])
@given(
    samples=st.lists(
        st.tuples(
            st.integers(-(10**7), 10**7) | st.integers(900, 8000),
            st.floats() | st.floats(0, 5),
            st.floats() | st.sampled_from([0.0, 1e-3, -1e-3, 0.02]),
            st.booleans(),
        ),
        max_size=8,
    )
)
def test_whatever_the_sensors_say_the_valve_gets_a_number_it_may_have(controller, samples):
    setup = LAWS[controller]
    state, tripped = first_state(setup, ZERO), False
    for tick, (counts, volts, dt_s, open_loop) in enumerate(samples):
        reference = make_valve_reference(Phase.OPEN_LOOP, 1.0) if open_loop else track()
        raw = RawSample(volts, counts, 0, 0)
        state, decision = step(setup, state, raw, reference, timing(tick, dt_s))
        assert abs(decision.valve_v) <= 5.0
        tripped = tripped or decision.tripped
        assert decision.tripped == tripped
        if tripped:
            assert decision.valve_v == setup.limits.safe_valve_v


SMC = """law: smc
length_unit: mm
lambda_per_s: 200
q: 1
kp: 0.1
eta: 25.4
phi: 2.54
lpf2_hz: 185
"""
PID = """law: pid
length_unit: mm
kp_v_per_length: 2
ki_v_per_length_s: 10
kd_v_s_per_length: 0.01
lpf2_hz: 100
"""


@pytest.fixture(scope="module", autouse=True)
def _laws(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("controller")
    LAWS["paper-table3-qsmc"] = SETUP
    for name, text in (("smc", SMC), ("pid", PID)):
        path = folder / f"{name}.yaml"
        path.write_text(text)
        LAWS[name] = build_tick_setup(run_settings(controller=str(path)))


LAWS: dict[str, TickSetup] = {}


def test_a_broken_wire_is_noticed_in_raw_volts_whatever_the_zero():
    state, decision = first_state(SETUP, Zero(0.0, 1000.0)), None
    for tick in range(30):
        state, decision = step(SETUP, state, sample(tick, volts=0.05), track(), timing(tick))
    assert decision is not None
    assert decision.verdicts & SENSOR_RANGE


# --- the record ------------------------------------------------------------------------


def test_every_column_of_the_log_has_its_own_name_and_a_plain_type():
    names = [field.name for field in TICK_FIELDS]
    assert len(names) == len(set(names))
    assert {field.kind for field in TICK_FIELDS} <= {int, float, bool}
    assert [field.stage for field in TICK_FIELDS] == sorted(
        (field.stage for field in TICK_FIELDS), key=TickRecord._fields.index
    )


def test_every_physical_column_says_its_unit():
    without = {field.name for field in TICK_FIELDS if not field.name.endswith(UNITS)}
    assert without == {"tick", "missed", "phase", "saturated", "verdicts", "tripped"}


UNITS = ("_s", "_s2", "_s3", "_v", "_m", "_pa", "_counts", "_ns")


# --- keyframes -------------------------------------------------------------------------


def test_a_keyframe_names_each_of_its_numbers_once():
    names = keyframe_fields(first_state(SETUP, ZERO))
    assert len(names) == len(set(names)) == len(freeze_state(first_state(SETUP, ZERO)))
    for expected in (
        "zero.sensor_zero_v",
        "filters.rate.pole",
        "law.absement_m_s",
        "safety.model_pressure_pa",
        "safety.tripped",
    ):
        assert expected in names


@pytest.mark.parametrize("law", ["paper-table3-qsmc", "smc", "pid"])
def test_a_thawed_state_goes_on_bit_for_bit(law):
    setup = LAWS[law]
    middle, _ = run(range(200), setup=setup)
    frozen = dict(zip(keyframe_fields(middle), freeze_state(middle), strict=True))
    again = thaw_state(first_state(setup, ZERO), frozen)
    assert again == middle
    straight = run(range(200, 400), middle, setup)
    assert run(range(200, 400), again, setup) == straight
    assert len({d.valve_v for d in straight[1]}) > 100


# --- its cost ------------------------------------------------------------------------------------


def test_a_rehearsal_takes_the_median_of_the_times_that_its_clock_shows():
    clock = count(0, 20_000)
    assert rehearse_tick_s(SETUP, 1e-3, lambda: next(clock)) == pytest.approx(20e-6)


@pytest.mark.parametrize("law", ["qsmc", "smc", "pid"])
def test_a_rehearsed_tick_computes_the_law_and_is_admitted(law, monkeypatch):
    """A tripped tick is shorter: the estimate would promise too much."""
    seen = []

    def watch(*arguments: Any) -> Any:
        seen.append(step(*arguments))
        return seen[-1]

    monkeypatch.setattr(run_ticks, "step", watch)
    setup = build_tick_setup(resolve(controller=law))
    rehearse_tick_s(setup, 1e-4, tick=TickRunner(setup, PlainCall))
    assert len(seen) == 100
    assert not any(decision.tripped for _, decision in seen)
    assert all(math.isfinite(state.command.command_v) for state, _ in seen[1:])


def test_a_rate_is_held_up_to_half_of_the_period_and_named_beyond():
    cost = TickCost.estimate(10e-6)
    assert cost.live_s == pytest.approx(LIVE_FACTOR * 10e-6)
    assert cost.held_hz == pytest.approx(BUSY_SHARE / cost.live_s)
    assert cost.find_warning(cost.held_hz) == ""
    warning = cost.find_warning(10_000.0)
    assert warning.startswith("rate_hz 10000 leaves 100 us for a tick that takes about 60 us")
    assert "About 8333 Hz can be held" in warning


def test_the_calls_of_a_slow_card_lower_the_rate():
    assert TickCost.estimate(10e-6, calls_s=190e-6).held_hz == pytest.approx(2000.0)


def test_a_run_that_cannot_hold_its_rate_says_so_in_one_line_and_in_its_log(monkeypatch, capsys):
    settings = run_settings()
    monkeypatch.setattr(loop_main, "rehearse_tick_s", lambda *_, **__: 1e-3)
    (event,) = loop_main.check_rate(settings, SETUP)
    said = capsys.readouterr().err
    assert event["event"] == "rate_warning"
    assert said == f"warning: {event['detail']}\n"
    assert said.count("\n") == 1
    assert "takes about 6000 us" in said

    monkeypatch.setattr(loop_main, "rehearse_tick_s", lambda *_, **__: 1e-6)
    assert loop_main.check_rate(settings, SETUP) == []
    assert capsys.readouterr().err == ""
