"""What every rig owes the loop, as cases that any test suite can run.

The author of a backend writes a factory that returns a fresh `RigBench`, and runs all cases:

    @pytest.mark.parametrize("case", RIG_CONTRACT)
    def test_the_rig_keeps_the_contract(case):
        case(make_bench)

Each case raises `AssertionError` where the rig breaks the contract. A real valve moves while
they run: shut the supply off first.
"""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from hal.backend import Backend, BuiltRig, RigRequest
from hal.calibration import Output
from hal.rig import RawSample, Rig, RigError, open_rig

_VOLTAGES = 200


@dataclass
class RigBench:
    """A rig that is not open yet, and a voltmeter on its output."""

    backend: Backend[Any]
    request: RigRequest[Any]
    built: BuiltRig
    """Usually `backend.build(request)`."""
    read_output_v: Callable[[], float]
    """What the device really puts out, whatever the rig says.

    With an output delay: what it puts out at the next sample.
    """

    @property
    def rig(self) -> Rig:
        """The rig under test."""
        return self.built.rig

    @cached_property
    def output(self) -> Output:
        """The output's range and codes, as the record gives them."""
        return self.backend.output(self.request.settings)

    @property
    def step_v(self) -> float:
        """Distance of two codes."""
        return 2.0 * self.output.converter.full_scale_v / self.output.converter.levels

    def volts_at(self, share: float) -> float:
        """Return a voltage of the output's range: 0 is its lowest, 1 its highest."""
        return self.output.lowest_v + share * (self.output.highest_v - self.output.lowest_v)

    def require_safe(self) -> None:
        """Fail unless the safe voltage is on the output and the rig says so."""
        output_v, safe_v = self.read_output_v(), self.request.safe_volts
        assert abs(output_v - safe_v) <= self.step_v, f"{output_v} V is out, {safe_v} V is safe"
        assert self.rig.safe_failure is None

    def require_closed(self) -> None:
        """Fail unless the rig refuses to read and to write."""
        for call in (self.rig.read, lambda: self.rig.write(self.volts_at(0.9))):
            _require_rig_error(call, "open")


MakeBench = Callable[[], RigBench]
"""Returns a fresh bench; the one before it is in use no more."""


def _require_rig_error(call: Callable[[], object], word: str) -> None:
    message = "no RigError was raised"
    try:
        call()
    except RigError as error:
        message = str(error)
    assert word in message, f"'{word}' is missing: {message}"


# --- the record --------------------------------------------------------------------------


def record_names_its_device_output_and_pace(make: MakeBench) -> None:
    """The record's answers suit the rig that it builds."""
    bench = make()
    record, settings = bench.backend, bench.request.settings
    assert isinstance(settings, record.settings)
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_.-]*", record.device(settings)), "a part of file names"
    assert bench.output.lowest_v < bench.output.highest_v
    record.require(settings)
    record.check(settings, bench.request.rate_hz)
    identity = bench.rig.describe()
    assert identity.backend == record.name
    assert (bench.built.await_edge is not None) == bool(identity.sample_clock)


def rig_describes_itself_before_open_in_json(make: MakeBench) -> None:
    """What is said before `open` still holds after it; all of it is JSON."""
    rig = make().rig
    before = rig.describe()
    metadata = before.as_metadata()
    assert json.loads(json.dumps(metadata, allow_nan=False)) == metadata
    rig.open()
    after = rig.describe()
    assert after._replace(extra=before.extra) == before
    assert {name: after.extra[name] for name in before.extra} == dict(before.extra)
    metadata = after.as_metadata()
    assert json.loads(json.dumps(metadata, allow_nan=False)) == metadata


def description_gives_the_safe_voltage_of_the_request(make: MakeBench) -> None:
    """The log's `safe_output_v` is the rig file's `safe_volts`."""
    bench = make()
    assert bench.rig.describe().safe_output_v == bench.request.safe_volts


# --- safe in every state -----------------------------------------------------------------


def safe_voltage_is_out_before_open_returns(make: MakeBench) -> None:
    """`open` drives the safe voltage first."""
    bench = make()
    bench.rig.open()
    bench.require_safe()


def make_safe_is_legal_in_every_state_any_number_of_times(make: MakeBench) -> None:
    """Before open, while open, after close; once or twice."""
    bench = make()
    rig = bench.rig

    def make_safe_twice() -> None:
        for _ in range(2):
            rig.make_safe()
            bench.require_safe()

    make_safe_twice()  # before open
    rig.open()
    make_safe_twice()  # before the first write
    rig.write(bench.volts_at(0.95))
    make_safe_twice()
    rig.write(bench.volts_at(0.05))
    rig.read()
    make_safe_twice()
    rig.close()
    make_safe_twice()


def close_ends_safe_and_may_be_repeated(make: MakeBench) -> None:
    """`close` makes safe, however often it is called."""
    bench = make()
    bench.rig.open()
    bench.rig.write(bench.volts_at(0.95))
    for _ in range(3):
        bench.rig.close()
        bench.require_safe()


def close_before_open_is_harmless(make: MakeBench) -> None:
    """A rig that was closed first opens and reads."""
    rig = make().rig
    rig.close()
    rig.open()
    rig.read()


def closed_rig_opens_again_safe(make: MakeBench) -> None:
    """Open and close may alternate."""
    bench = make()
    for _ in range(3):
        with open_rig(bench.rig):
            bench.require_safe()
            bench.rig.read()
            assert bench.rig.write(bench.volts_at(0.8)) == bench.read_output_v()


def exception_leaves_the_rig_safe_and_closed(make: MakeBench) -> None:
    """`open_rig` ends safe, whatever is raised in its block."""
    for raised in (ValueError, KeyboardInterrupt, SystemExit):
        bench = make()
        try:
            with open_rig(bench.rig):
                bench.rig.write(bench.volts_at(0.95))
                raise raised
        except raised:
            bench.require_safe()
        bench.require_closed()


def rig_that_is_not_open_refuses_to_read_and_write(make: MakeBench) -> None:
    """`RigError` before `open` and after `close`; the output stays safe."""
    bench = make()
    for _ in range(2):
        bench.require_closed()
        bench.rig.open()
        bench.rig.close()
    bench.require_safe()


# --- samples -----------------------------------------------------------------------------


def every_read_is_fresh(make: MakeBench) -> None:
    """Each channel is sampled after `read` is called and before it returns."""
    bench = make()
    now_ns = bench.request.now_ns
    bench.rig.open()
    for _ in range(5):
        before_ns = now_ns()
        sample = bench.rig.read()
        after_ns = now_ns()
        assert before_ns <= sample.pressure_t_ns <= after_ns
        assert before_ns <= sample.encoder_t_ns <= after_ns


def sample_is_volts_and_whole_counts(make: MakeBench) -> None:
    """A float and three ints: a NumPy scalar would reach the log."""
    rig = make().rig
    rig.open()
    sample = rig.read()
    assert isinstance(sample, RawSample)
    assert math.isfinite(sample.pressure_v)
    assert [type(value) for value in sample] == [float, int, int, int]


def awaited_edge_is_the_one_that_read_returns(make: MakeBench) -> None:
    """A rig that paces the loop: `read` returns the sample of the edge that was awaited last."""
    bench = make()
    await_edge = bench.built.await_edge
    if await_edge is None:
        return
    bench.rig.open()
    last_ns = -math.inf
    for _ in range(5):
        edge = await_edge()
        assert last_ns < edge.t_ns <= edge.now_ns
        assert edge.elapsed >= 1
        assert bench.rig.read().pressure_t_ns == edge.t_ns
        last_ns = edge.t_ns


# --- the output --------------------------------------------------------------------------


def write_within_the_range_goes_to_the_nearest_code(make: MakeBench) -> None:
    """The volts returned are the volts on the output, half a code away at the most."""
    bench = make()
    output, step_v = bench.output, bench.step_v
    bench.rig.open()
    for volts in _spread(output.lowest_v, output.highest_v):
        applied_v = bench.rig.write(volts)
        assert applied_v == bench.read_output_v()
        assert abs(applied_v - volts) <= step_v / 2 * (1 + 1e-9), f"{volts} V became {applied_v} V"
        assert applied_v / step_v == round(applied_v / step_v)


def write_outside_the_range_stops_at_its_end(make: MakeBench) -> None:
    """A voltage of any size is clamped to the range."""
    bench = make()
    low_v, high_v = bench.output.lowest_v, bench.output.highest_v
    bench.rig.open()
    for beyond in (1e-9, 0.1, 3.0, 1e9, 1.7e308):
        for volts, end_v in ((high_v + beyond, high_v), (low_v - beyond, low_v)):
            assert bench.rig.write(volts) == end_v == bench.read_output_v(), f"at {volts} V"


def write_that_is_no_number_is_refused_and_changes_nothing(make: MakeBench) -> None:
    """NaN and infinity raise `RigError`; the rig goes on."""
    bench = make()
    bench.rig.open()
    for volts in (math.nan, math.inf, -math.inf):
        applied_v = bench.rig.write(bench.volts_at(0.85))
        _require_rig_error(lambda volts=volts: bench.rig.write(volts), "finite")  # type: ignore[misc]
        assert bench.read_output_v() == applied_v
        assert bench.rig.write(bench.volts_at(0.65)) == bench.read_output_v() != applied_v


def _spread(low_v: float, high_v: float) -> Sequence[float]:
    """Return both ends and many voltages between them, the same ones every time."""
    draw = random.Random(1)
    return [low_v, high_v, *(draw.uniform(low_v, high_v) for _ in range(_VOLTAGES))]


RIG_CONTRACT: tuple[Callable[[MakeBench], None], ...] = (
    record_names_its_device_output_and_pace,
    rig_describes_itself_before_open_in_json,
    description_gives_the_safe_voltage_of_the_request,
    safe_voltage_is_out_before_open_returns,
    make_safe_is_legal_in_every_state_any_number_of_times,
    close_ends_safe_and_may_be_repeated,
    close_before_open_is_harmless,
    closed_rig_opens_again_safe,
    exception_leaves_the_rig_safe_and_closed,
    rig_that_is_not_open_refuses_to_read_and_write,
    every_read_is_fresh,
    sample_is_volts_and_whole_counts,
    awaited_edge_is_the_one_that_read_returns,
    write_within_the_range_goes_to_the_nearest_code,
    write_outside_the_range_stops_at_its_end,
    write_that_is_no_number_is_refused_and_changes_nothing,
)
