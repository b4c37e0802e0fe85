"""Ticks in machine code: series of them, under each law, to every verdict of safety."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest
from every_kernel import begin, bits, make_setups
from hypothesis import given
from hypothesis import strategies as st

from hal.rig import RawSample
from pamctl import safety
from pamctl.control.law_registry import installed_laws
from pamctl.kernel.build import find_compiler
from pamctl.kernel.calls import NativeCall, PlainCall, prepare
from pamctl.kernel.layout import Block
from pamctl.realtime.tick import TickSetup, TickState, step
from pamctl.signals import Decision, Phase, Reference, Timing

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

LAWS = sorted(installed_laws())


class Input(NamedTuple):
    """What a tick begins with."""

    raw: RawSample
    reference: Reference
    timing: Timing


def tick_once(
    setup: TickSetup, state: TickState, given: Input, decision: Decision
) -> tuple[TickState, Decision]:
    """Kernel: one tick; the last decision is replaced."""
    return step(setup, state, given.raw, given.reference, given.timing)


def make_input(
    k: int = 0,
    *,
    pressure_v: float = 0.3,
    counts: int = 0,
    dt_s: float = 1e-3,
    missed: int = 0,
    reference_m: float = 0.0,
    valve_v: float = math.nan,
    phase: Phase = Phase.TRACK,
) -> Input:
    return Input(
        RawSample(pressure_v, counts, k * 10**6, k * 10**6),
        Reference(int(phase), reference_m, 0.1, 0.0, 0.0, valve_v),
        Timing(k, k * 1e-3, dt_s, 0.0, missed),
    )


@pytest.fixture(scope="module", params=LAWS)
def law_setup(request: pytest.FixtureRequest) -> tuple[TickSetup, NativeCall]:
    """The set-up of a law, and its tick in machine code."""
    setup = make_setups()[request.param]
    return setup, prepare_tick(setup)


def prepare_tick(setup: TickSetup) -> NativeCall:
    arguments = {"setup": setup, "state": begin(setup), "given": make_input(), "decision": NONE_YET}
    call = prepare(tick_once, arguments, updates=("state", "decision"))
    assert isinstance(call, NativeCall)
    return call


NONE_YET = Decision(0.0, 0, False)


def run_both(call: NativeCall, setup: TickSetup, inputs: list[Input]) -> Iterator[Decision]:
    """Run ticks in C and in Python; hold all results against each other."""
    plain = PlainCall(tick_once, {}, updates=("state", "decision"))
    blocks = {name: call.blocks[name] for name in ("state", "decision")}
    for each in (call, plain):
        for name, value in (("setup", setup), ("state", begin(setup)), ("decision", NONE_YET)):
            each.put(name, value)
    for given_ in inputs:
        raised = []
        for each in (plain, call):
            each.put("given", given_)
            before = [list_bits(block, each.get(name)) for name, block in blocks.items()]
            try:
                each.run()
            except (ArithmeticError, ValueError) as error:
                raised.append((type(error), str(error)))
                after = [list_bits(block, each.get(name)) for name, block in blocks.items()]
                assert after == before, "a tick that fails changes nothing"
        assert not raised or (len(raised) == 2 and raised[0] == raised[1])
        for name, block in blocks.items():
            assert list_bits(block, call.get(name)) == list_bits(block, plain.get(name)), name
        yield call.get("decision")


def list_bits(block: Block[Any], value: Any) -> list[bytes]:
    return [*map(bits, block.flatten(value, []))]


numbers = st.one_of(
    st.floats(),
    st.floats(-1e3, 1e3),
    st.sampled_from((math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, 1e308)),
)
inputs = st.builds(
    make_input,
    st.integers(-(2**40), 2**40),
    pressure_v=st.one_of(st.floats(0.0, 5.0), numbers),
    counts=st.one_of(st.integers(-5000, 5000), st.integers(-(2**63), 2**63 - 1)),
    dt_s=st.one_of(st.just(1e-3), st.floats(-1e-3, 0.06), numbers),
    missed=st.one_of(st.integers(0, 200), st.integers(-(2**63), 2**63 - 1)),
    reference_m=st.one_of(st.floats(0.0, 0.02), numbers),
    valve_v=st.one_of(st.just(math.nan), st.floats(-6.0, 6.0), numbers),
    phase=st.sampled_from(Phase),
)


@given(series=st.lists(inputs, min_size=1, max_size=12))
def test_any_series_of_ticks_gives_the_same_bits_or_the_same_error(
    law_setup: tuple[TickSetup, NativeCall], series: list[Input]
) -> None:
    setup, call = law_setup
    for _ in run_both(call, setup, series):
        pass


AT_REST = {"reference_m": math.nan, "valve_v": 0.0, "pressure_v": 0.2, "phase": Phase.OPEN_LOOP}
TRACKING = {"reference_m": 0.0, "valve_v": math.nan, "pressure_v": 0.2}
FAULTS: dict[int, tuple[dict[str, Any], dict[str, Any]]] = {
    safety.ENVELOPE: (AT_REST | {"valve_v": 7.0}, {}),
    safety.SLEW: (TRACKING | {"reference_m": 1e-3}, {"slew_v_per_s": 0.5}),
    safety.PINNED: (AT_REST, {"pinned": True}),
    safety.COMMAND_NOT_FINITE: (AT_REST | {"valve_v": math.inf}, {}),
    safety.MEASUREMENT_NOT_FINITE: (AT_REST | {"pressure_v": math.nan}, {}),
    safety.PRESSURE_LIMIT: (AT_REST | {"pressure_v": 3.0}, {}),
    safety.STROKE_LIMIT: (AT_REST | {"counts": -1000}, {}),
    safety.SENSOR_RANGE: (AT_REST | {"pressure_v": 0.0}, {}),
    safety.ENCODER_JUMP: (AT_REST | {"counts": 5000}, {}),
    safety.TRACKING_ERROR: (TRACKING | {"reference_m": 0.01}, {}),
    safety.STALE_SAMPLE: (AT_REST | {"dt_s": 0.0}, {}),
    safety.OVERRUNS: (AT_REST | {"missed": 200}, {}),
    safety.PRESSURE_TOO_LOW: (AT_REST | {"valve_v": 5.0}, {}),
    safety.PRESSURE_TOO_HIGH: (AT_REST | {"valve_v": -5.0, "pressure_v": 1.5}, {}),
}
"""For each verdict: what the ticks begin with once there is the fault, and other limits."""


@pytest.mark.parametrize("verdict", safety.VERDICTS)
def test_every_verdict_is_reached_in_c_as_in_python(
    law_setup: tuple[TickSetup, NativeCall], verdict: int
) -> None:
    setup, call = law_setup
    fault, limits = FAULTS[verdict]
    setup = setup._replace(limits=setup.limits._replace(**limits))
    series = [make_input(k, **(fault if k > 9 else AT_REST)) for k in range(60)]
    verdicts = [decision.verdicts for decision in run_both(call, setup, series)]
    assert verdict in (safety.PINNED, verdicts[9] ^ verdict), "at rest there is no verdict"
    assert any(seen & verdict for seen in verdicts[10:])


def test_a_compensation_gives_the_same_bits() -> None:
    setup = next(its for its in make_setups().values() if its.compensation is not None)
    series = [make_input(k, reference_m=1e-4 * k, counts=20 * k) for k in range(60)]
    (*_, last) = run_both(prepare_tick(setup), setup, series)
    assert math.isfinite(last.valve_v)
