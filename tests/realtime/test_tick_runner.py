"""Machine code and plain Python are one tick: the same bits, whatever comes in."""

import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import pytest
from support.runs import MS, MemoryJournal, ScriptedSupervisor, pack_row, parts, run_settings

from hal.calibration import Zero
from hal.faulty import FaultSettings
from hal.rig import RawSample
from pamctl.base.errors import Ending
from pamctl.control.law import answer
from pamctl.kernel.calls import NativeCall, PlainCall
from pamctl.kernel.expressions import NotInC
from pamctl.realtime.clock import Wake
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.program import CuedHelm
from pamctl.realtime.tick import TickSetup, first_state
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.ring import Ring
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Reference, TickOutcome, TickRecord, Truth

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the real-time loop needs Linux")

SETUP = build_tick_setup(run_settings())
NO_OUTCOME, NO_TRUTH = TickOutcome(0.0, 0.0, 0.0, 0.0), Truth(math.nan, math.nan)
SHORT = (
    "experiment.approach_s=0.6",
    "experiment.settle_s=0.2",
    "experiment.transition_s=0.7",
    "experiment.cycles=1",
    "rig.loop.stop_ramp_s=0.1",
)


def plain_tick(setup: TickSetup = SETUP) -> TickRunner:
    return TickRunner(setup, PlainCall)


@pytest.fixture
def compiled() -> TickRunner:
    """The machine code of the paper's law."""
    return TickRunner(SETUP, NativeCall)


def pack(record: TickRecord) -> bytes:
    return bytes(pack_row(record))


def run_with(
    tick: TickRunner,
    settings: RunSettings,
    *faults: FaultSettings,
    missed: Any = None,
    make_helm: Callable[..., CuedHelm] = CuedHelm,
    make_supervisor: Callable[[CuedHelm], ScriptedSupervisor] = lambda helm: ScriptedSupervisor(),
) -> tuple[Ending, MemoryJournal]:
    setup, made = build_tick_setup(settings), parts(settings, faults, missed)
    journal, program = MemoryJournal(), build_program(settings)
    helm = make_helm(setup, settings.controller.model_dump(mode="json"), program, journal)
    ending = ControlLoop(
        rig=made.whole,
        clock=made.clock,
        setup=setup,
        nominal_zero=nominal_zero_of(settings),
        program=program,
        journal=journal,
        supervisor=make_supervisor(helm),
        truth=lambda: Truth(0.0, 0.0),
        helm=helm,
        tick=tick,
    ).run()
    return ending, journal


def run_both(settings: RunSettings, **how: Any) -> list[bytes]:
    """Run in plain Python and in machine code; return the rows, which must be the same."""
    plain, fast = (
        [
            *map(
                pack,
                run_with(TickRunner(build_tick_setup(settings), kind), settings, **how)[1].ticks,
            )
        ]
        for kind in (PlainCall, NativeCall)
    )
    assert plain == fast
    return plain


RUNS: dict[str, tuple[Sequence[str], Sequence[FaultSettings], dict[int, int]]] = {
    "homing, tracking and stop": (SHORT, (), {}),
    "missed ticks": ((*SHORT, "rig.homing.enabled=false"), (), {700: 3, 1300: 20}),
    "a broken wire": (
        (*SHORT, "rig.homing.enabled=false"),
        (FaultSettings(kind="broken_wire", from_tick=900, ticks=10**9, size=0.0),),
        {},
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", RUNS)
def test_a_run_has_the_same_rows_events_and_frozen_states(name):
    overrides, faults, missed = RUNS[name]
    settings = run_settings(*overrides)
    setup = build_tick_setup(settings)
    ended, plain = run_with(plain_tick(setup), settings, *faults, missed=missed)
    ended_too, fast = run_with(TickRunner(setup, NativeCall), settings, *faults, missed=missed)
    assert ended == ended_too
    assert len(plain.ticks) > 500
    assert [*map(pack, plain.ticks)] == [*map(pack, fast.ticks)]
    assert repr(plain.events) == repr(fast.events)
    assert repr(plain.keyframes) == repr(fast.keyframes)


def test_gains_that_change_on_a_ramp_are_followed():
    settings = run_settings(*SHORT, "rig.homing.enabled=false")
    softened = run_both(
        settings, make_helm=lambda setup, *others: Softening(settings, setup, *others)
    )
    assert softened != run_both(settings)


def test_another_law_than_the_one_built_runs_in_plain_python():
    other = run_settings(controller="smc").controller
    rows = run_both(run_settings(*SHORT), make_supervisor=lambda helm: Replacing(helm, other))
    assert len(rows) > 2000


class Replacing(ScriptedSupervisor):
    """Replaces the law at tick 100, during homing: then no law moves the muscle."""

    def __init__(self, helm: CuedHelm, other: Any) -> None:
        super().__init__()
        self._helm, self._other = helm, other

    def find_stop(self, tick: int) -> Ending | None:
        if tick == 100:
            self._helm._tuning.replace(self._other)
        return None


class Softening(CuedHelm):
    """Begins a ramp to softer gains at tick 300."""

    def __init__(self, settings: RunSettings, *others: Any) -> None:
        self.controller = settings.controller
        super().__init__(*others)

    def finish_tick(self, done: TickRunner) -> None:
        if done.timing.tick == 300:
            softer = self.controller.model_copy(update={"lpf1_hz": 200.0})
            self._tuning.change(softer, done.timing.t_s, 0.2)
        super().finish_tick(done)


def test_where_machine_code_fails_plain_python_says_why(compiled):
    limits = SETUP.limits._replace(pressure_model_memory_s=0.0)
    broken = SETUP._replace(limits=limits)
    compiled.begin(first_state(SETUP, Zero(0.2, 0.0)), 0, -MS)
    reference = Reference(2, 0.0, 0.0, 0.0, 0.0, math.nan)
    compiled.run(broken, Wake(0, 0, 0, 0), RawSample(0.3, 0, 0, 0), reference)
    before = compiled.state
    with pytest.raises(ZeroDivisionError):
        compiled.run(broken, Wake(1, MS, MS, 0), RawSample(0.3, 0, MS, MS), reference)
    assert compiled.state == before, "a tick that failed changes nothing"


def test_a_rehearsal_changes_neither_state_nor_ring(compiled, tmp_path):
    from support.made_up import meta

    compiled.begin(first_state(SETUP, Zero(0.2, 0.0)), 0, -MS)
    reference = Reference(2, 0.0, 0.0, 0.0, 0.0, math.nan)
    with Ring.create(tmp_path / "a.ring", meta(tmp_path / "none"), 256) as ring:
        compiled.run(SETUP, Wake(0, 0, 0, 0), RawSample(0.3, 0, 0, 0), reference)
        compiled.record(RingOnly(ring), NO_OUTCOME, NO_TRUTH)
        before, rows, head = compiled.state, ring.drain(256), ring.head
        for _ in range(3):
            compiled.rehearse(lambda t_s: None, RingOnly(ring))
        assert (compiled.state, ring.drain(256), ring.head) == (before, rows, head)


class RingOnly(MemoryJournal):
    def __init__(self, ring: Ring) -> None:
        super().__init__()
        self._ring = ring

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        self._ring.put_row(row)

    def rehearse_row(self, row: bytearray) -> None:
        self._ring.rehearse_row(row)


def test_a_law_that_is_no_kernel_is_refused_with_its_line_and_the_reason():
    class Strange(NamedTuple):
        gain: float = 1.0

    @answer.register(Strange)
    def respond_strangely(gains, memory, reference, estimate, dt_s):  # type: ignore[no-untyped-def]
        return sorted([1.0]), memory

    setup = SETUP._replace(gains=Strange(), armed=NoMemory())
    with pytest.raises(NotInC, match=r"test_tick_runner\.py:\d+: .*respond_strangely: `sorted"):
        TickRunner(setup, NativeCall)


class NoMemory(NamedTuple):
    pass
