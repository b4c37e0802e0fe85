"""Everything that can go wrong with a rig, over the card's stand-in.

On the simulated rig: `test_loop.py`. What fails in a call is tried on the card on demand and on the
card paced by its own clock. However a run ends, the output is at the safe voltage and the log says
why. Time is made up here; faults that need real processes are in `test_card_runs.py`.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest
from standin.standin import PERMIT, Card, here
from support.card_rigs import READ_COUNT, READ_VOLTS, WRITE, hardware_timed, on_demand
from support.runs import AO_STEP_V, MemoryJournal, ScriptedSupervisor, run_settings, steered

from hal.rig import RawSample, Rig
from pamctl.base.errors import Ending, ExitCode
from pamctl.kernel.calls import PlainCall
from pamctl.processes.loop_main import run_to_ending
from pamctl.realtime import run_ticks
from pamctl.realtime.clock import Clock
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.tick_runner import TickRunner
from pamctl.safety import (
    ENCODER_JUMP,
    PRESSURE_LIMIT,
    PRESSURE_TOO_HIGH,
    PRESSURE_TOO_LOW,
    SENSOR_RANGE,
    STROKE_LIMIT,
    TRACKING_ERROR,
)
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Truth

SAFE_V = 0.625
BEGINS = 1500
"""The tick in which the fault begins: the muscle is contracting then."""
MOVING = (
    "rig.homing.enabled=false",
    f"rig.safe_volts={SAFE_V}",
    "rig.limits.sample_age_s=0.05",
    "rig.limits.missed_ticks=100",
    "rig.sim.sensor_zero_v=0.2",
    "experiment.approach_s=1.0",
    "experiment.settle_s=0.2",
    "experiment.transition_s=1.5",
    "rig.loop.stop_ramp_s=0.1",
)
SQUARES = ("rig.homing.enabled=false", f"rig.safe_volts={SAFE_V}")


class Bench(NamedTuple):
    """A rig before its run, and the way to spoil it."""

    rig: Rig
    clock: Clock
    spoil: Callable[[str], None]
    """Called in the tick in which the fault begins, right after its read."""
    output_v: Callable[[], float]
    truth: Callable[[], Truth]


def on_card(timed: Callable[[Card, float], tuple[Rig, Clock]]) -> Callable[..., Bench]:
    def bench(settings: RunSettings, fault: str) -> Bench:
        card = here()
        card.power_up()
        card.stop_time()
        card.registers.sensor_zero_v = 0.2
        rig, clock = timed(card, settings.rig.safe_volts)
        unknown = Truth(math.nan, math.nan)
        spoil = CARD[fault]
        return Bench(rig, clock, lambda f: spoil(card), lambda: card.output_v, lambda: unknown)

    return bench


class Spoiled:
    """Passes everything through, and spoils the rig when its tick has come."""

    def __init__(self, rig: Rig, spoil: Callable[[], None]) -> None:
        self._rig = rig
        self._spoil = spoil
        self._reads = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    def read(self) -> RawSample:
        sample = self._rig.read()
        self._reads += 1
        if self._reads == BEGINS:
            self._spoil()
        return sample


@pytest.fixture(autouse=True)
def _card(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv(PERMIT, "1")
    yield
    here().mend()


def fail(*functions: str, code: int = -201003, **how: Any) -> Callable[[Card], None]:
    def spoil(card: Card) -> None:
        for function in functions:
            card.fail(function, code, **how)

    return spoil


def set_to(**registers: float) -> Callable[[Card], None]:
    def spoil(card: Card) -> None:
        for name, value in registers.items():
            setattr(card.registers, name, value)

    return spoil


def jump(card: Card) -> None:
    card.registers.counter = (card.registers.counter + 6000) % 2**32


# What happens to the card. A failing write works again soon: no software can make a card safe whose
# output cannot be written at all.
CARD: dict[str, Callable[[Card], None]] = {
    "read fails": fail(READ_VOLTS),
    "write fails": fail(WRITE, times=3),
    "read and write fail": lambda card: (fail(READ_COUNT)(card), fail(WRITE, times=3)(card)),
    "read hangs": fail(READ_VOLTS, code=0, hang_s=0.1, times=1),
    "broken wire": set_to(wire_is_broken=1),
    "open input stands": set_to(wire_is_broken=1, pull_down_is_missing=1),
    "open input rises": set_to(wire_is_broken=1, pull_down_is_missing=1, open_drift_v_per_s=3.0),
    "open input falls": set_to(wire_is_broken=1, pull_down_is_missing=1, open_drift_v_per_s=-1.0),
    "encoder unplugged": set_to(encoder_is_unplugged=1),
    "encoder reversed": set_to(encoder_sign=-1),
    "encoder jumps": jump,
    "valve stuck open": set_to(valve_is_stuck=1, valve_stuck_v=10.0),
    "valve stuck closed": set_to(valve_is_stuck=1, valve_stuck_v=5.0),
}

UNAVAILABLE, TRIP = ExitCode.UNAVAILABLE, ExitCode.SAFETY_TRIP
EXPECTED: dict[str, tuple[ExitCode, int]] = {
    "read fails": (UNAVAILABLE, 0),
    "write fails": (UNAVAILABLE, 0),
    "read and write fail": (UNAVAILABLE, 0),
    "read hangs": (UNAVAILABLE, 0),
    "broken wire": (TRIP, SENSOR_RANGE),
    # Without a pull-down an open input trips once its voltage is no longer plausible.
    "open input rises": (TRIP, PRESSURE_LIMIT | PRESSURE_TOO_HIGH),
    "open input falls": (TRIP, SENSOR_RANGE | PRESSURE_TOO_LOW),
    "encoder unplugged": (TRIP, TRACKING_ERROR),
    "encoder reversed": (TRIP, TRACKING_ERROR | STROKE_LIMIT | ENCODER_JUMP),
    "encoder jumps": (TRIP, ENCODER_JUMP),
    "valve stuck open": (TRIP, PRESSURE_TOO_HIGH | TRACKING_ERROR),
    "valve stuck closed": (TRIP, PRESSURE_TOO_LOW | PRESSURE_TOO_HIGH | TRACKING_ERROR),
}
BENCHES = {"card": on_card(on_demand), "card's clock": on_card(hardware_timed)}
ON_BOTH = {
    "read fails", "write fails", "read and write fail", "read hangs", "broken wire",
    "encoder jumps",
}  # fmt: skip
CASES = [
    (bench, fault) for bench in BENCHES for fault in EXPECTED if bench == "card" or fault in ON_BOTH
]


def ran(
    bench: str, fault: str, settings: RunSettings, supervisor: ScriptedSupervisor | None = None
) -> tuple[Ending, MemoryJournal, float]:
    """Run with a fault; return how it ended, what is on record, and what is on the output."""
    made, journal = BENCHES[bench](settings, fault), MemoryJournal()
    try:
        ending = ControlLoop(
            rig=Spoiled(made.rig, lambda: made.spoil(fault)),  # type: ignore[arg-type]
            clock=made.clock,
            **steered(settings, journal),
            supervisor=supervisor or ScriptedSupervisor(),
            truth=made.truth,
        ).run()
        return ending, journal, made.output_v()
    finally:
        here().mend()
        made.rig.close()


def test_an_open_input_that_stands_still_is_noticed_by_nothing_in_a_run():
    """It is why the wiring page asks for a pull-down: this voltage is quiet and plausible."""
    settings = run_settings(*MOVING, controller="qsmc")
    stopped = ScriptedSupervisor(Ending(ExitCode.OK, "long enough"), stop_at=BEGINS + 2500)
    ending, journal, output_v = ran("card", "open input stands", settings, stopped)
    assert ending.code == ExitCode.OK
    assert len({tick.raw.pressure_v for tick in journal.ticks[-500:]}) == 1
    assert output_v == pytest.approx(SAFE_V, abs=AO_STEP_V)


@pytest.mark.parametrize(("bench", "fault"), CASES)
def test_a_fault_ends_the_run_safe_with_its_exit_code_and_its_reason(bench, fault):
    settings = run_settings(*MOVING, controller="qsmc")
    ending, journal, output_v = ran(bench, fault, settings)
    code, verdicts = EXPECTED[fault]
    assert ending.code == code, ending.reason
    assert output_v == pytest.approx(SAFE_V, abs=AO_STEP_V)
    last = journal.ticks[-1]
    if code == TRIP:
        assert last.decision.verdicts & verdicts
        assert journal.named("tripped")
    else:
        assert "device error" in ending.reason
    # Complete to the last tick, and no later than the fault can go unseen.
    assert [record.timing.tick for record in journal.ticks] == list(range(len(journal.ticks)))
    assert BEGINS - 1 <= len(journal.ticks) < BEGINS + 1600


@pytest.mark.parametrize("stuck_v", [0.0, 10.0])
def test_a_valve_that_is_stuck_is_noticed_by_the_pressure_alone(stuck_v, monkeypatch):
    """Open loop there is no tracking error that could give it away."""
    monkeypatch.setitem(CARD, "stuck", set_to(valve_is_stuck=1, valve_stuck_v=stuck_v))
    ending, journal, output_v = ran(
        "card", "stuck", run_settings(*SQUARES, experiment="square-0.5")
    )
    assert ending.code == TRIP
    assert journal.ticks[-1].decision.verdicts in (PRESSURE_TOO_HIGH, PRESSURE_TOO_LOW)
    assert output_v == pytest.approx(SAFE_V, abs=AO_STEP_V)


def test_an_exception_in_the_law_is_the_ending_and_leaves_the_output_safe(monkeypatch):
    right = run_ticks.step

    def wrong(setup: Any, state: Any, raw: Any, reference: Any, timing: Any) -> Any:
        if timing.tick == BEGINS:
            raise ZeroDivisionError("in the law")
        return right(setup, state, raw, reference, timing)

    monkeypatch.setattr(run_ticks, "step", wrong)
    monkeypatch.setitem(CARD, "none", lambda card: None)
    settings = run_settings(*MOVING)
    made, journal = BENCHES["card's clock"](settings, "none"), MemoryJournal()
    steering = steered(settings, journal)
    loop = ControlLoop(
        rig=made.rig,
        clock=made.clock,
        tick=TickRunner(steering["setup"], PlainCall),
        **steering,
        supervisor=ScriptedSupervisor(),
        truth=made.truth,
    )
    reason = "ZeroDivisionError: in the law"
    assert run_to_ending(loop.run) == Ending(ExitCode.UNEXPECTED, reason)
    assert len(journal.ticks) == BEGINS
    assert journal.ticks[-1].outcome.applied_v > SAFE_V + 1.0
    assert made.output_v() == pytest.approx(SAFE_V, abs=AO_STEP_V)
