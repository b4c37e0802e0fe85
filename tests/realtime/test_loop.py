"""The loop from end to end in memory: however a run ends, the rig is safe and the log says why."""

import math
from itertools import pairwise
from typing import Any

import pytest
from support.runs import (
    AO_STEP_V,
    MS,
    MemoryJournal,
    Run,
    ScriptedSupervisor,
    parts,
    run,
    run_settings,
    steered,
)

from hal.faulty import FaultSettings
from hal.rig import RigError
from pamctl.base.errors import Ending, ExitCode
from pamctl.realtime import loop, run_ticks
from pamctl.realtime.loop import KEYFRAME_TICKS
from pamctl.realtime.tick import keyframe_fields
from pamctl.safety import (
    ENCODER_JUMP,
    MEASUREMENT_NOT_FINITE,
    SENSOR_RANGE,
    STALE_SAMPLE,
    STROKE_LIMIT,
    TRACKING_ERROR,
    explain_verdicts,
)
from pamctl.settings.build import build_tick_setup
from pamctl.signals import Phase

SHORT = (
    "experiment.approach_s=1.0",
    "experiment.settle_s=0.2",
    "experiment.transition_s=1.5",
    "experiment.cycles=1",
    "rig.loop.stop_ramp_s=0.1",
)
UNHOMED = (*SHORT, "rig.homing.enabled=false")
APPROACH_TICKS, TRACK_TICKS, STOP_TICKS = 1200, 3000, 100
SAFE_OUTPUT_V = 1.0
BENCH = (
    f"rig.safe_volts={SAFE_OUTPUT_V}",
    "rig.limits.sample_age_s=0.05",
    "rig.limits.missed_ticks=100",
)


def short(*overrides: str, **choices: Any):
    """Four seconds of tracking with a safe voltage that nothing else would put out."""
    return run_settings(*UNHOMED, *BENCH, *overrides, **choices)


def fault(kind: str, from_tick: int = 2000, ticks: int = 10**9, size: float = 0.0) -> FaultSettings:
    return FaultSettings(kind=kind, from_tick=from_tick, ticks=ticks, size=size)


def assert_left_safe(ran: Run) -> None:
    assert ran.rig.output_v == pytest.approx(SAFE_OUTPUT_V, abs=AO_STEP_V / 2)
    with pytest.raises(RigError, match="not open"):
        ran.rig.read()


# --- an undisturbed run ----------------------------------------------------------------


@pytest.fixture(scope="module")
def undisturbed() -> Run:
    return run(short())


def test_every_tick_is_on_record_once_and_in_order(undisturbed):
    ticks = [record.timing.tick for record in undisturbed.journal.ticks]
    assert ticks == list(range(APPROACH_TICKS + TRACK_TICKS + STOP_TICKS))
    phases = [record.reference.phase for record in undisturbed.journal.ticks]
    assert (
        phases
        == [Phase.APPROACH] * APPROACH_TICKS
        + [Phase.TRACK] * TRACK_TICKS
        + [Phase.STOPPING] * STOP_TICKS
    )


def test_a_record_says_what_was_applied_to_the_code(undisturbed):
    for record in undisturbed.journal.ticks:
        asked_v = 5.0 + record.decision.valve_v
        assert abs(record.outcome.applied_v - asked_v) <= AO_STEP_V / 2 * (1 + 1e-9)
        assert (record.outcome.applied_v / AO_STEP_V).is_integer()


def test_without_a_clock_all_durations_are_zero_and_all_ticks_one_period(undisturbed):
    for record in undisturbed.journal.ticks:
        assert record.outcome[1:] == (0.0, 0.0, 0.0)
        assert record.timing.dt_s == pytest.approx(1e-3, abs=1e-15)
        assert record.timing.t_s == pytest.approx(record.timing.tick * 1e-3, abs=1e-12)
        assert (record.timing.late_s, record.timing.missed) == (0.0, 0)


def test_the_muscle_followed_its_reference(undisturbed):
    settled = undisturbed.journal.phase(Phase.TRACK)
    true_m = [record.truth.true_position_m - record.reference.reference_m for record in settled]
    assert max(map(abs, true_m)) < 1.5e-3
    reached = [record.truth.true_position_m for record in settled]
    assert max(reached) == pytest.approx(17.2e-3, abs=1.5e-3)


def test_the_stop_is_a_ramp_from_the_last_command_to_the_safe_one(undisturbed):
    last = undisturbed.journal.phase(Phase.TRACK)[-1].decision.valve_v
    ramp = [record.decision.valve_v for record in undisturbed.journal.phase(Phase.STOPPING)]
    safe_v = SAFE_OUTPUT_V - 5.0
    for n, valve_v in enumerate(ramp):
        assert valve_v == pytest.approx(last + (safe_v - last) * n / STOP_TICKS, abs=1e-6)
    assert abs(ramp[-1] - safe_v) < 0.05
    assert undisturbed.journal.named("stopping") == [
        {"event": "stopping", "reason": "the experiment is complete"}
    ]


def test_once_a_second_a_keyframe_holds_the_state_after_its_tick(undisturbed):
    assert [tick for tick, _ in undisturbed.journal.keyframes] == [999, 1999, 2999, 3999]
    names = keyframe_fields(loop.first_state(build_tick_setup(short()), loop.Zero(0.0, 0.0)))
    for tick, state in undisturbed.journal.keyframes:
        record = undisturbed.journal.ticks[tick]
        numbers = dict(zip(names, state, strict=True))
        assert numbers["measurement.position_m"] == record.measurement.position_m
        assert numbers["command.command_v"] == record.command.command_v
        assert numbers["safety.valve_v"] == record.decision.valve_v
    assert KEYFRAME_TICKS == 1000


def test_with_an_output_delay_the_run_ends_as_well():
    delayed = run(short("rig.sim.output_delay_ticks=1"))
    assert delayed.ending.code == ExitCode.OK
    assert_left_safe(delayed)


# --- homing ----------------------------------------------------------------------------


def homing(*overrides: str, **changes: Any) -> Run:
    return run(run_settings(*SHORT, *BENCH, *overrides), **changes)


def test_homing_comes_first_and_its_zeros_are_on_record():
    homed = homing("duration_s=0.5")
    assert homed.ending.code == ExitCode.OK
    nominal, found = homed.journal.named("zeroed")
    assert (nominal["sensor_zero_v"], nominal["encoder_zero_counts"]) == (0.2, 1000.0)
    assert found["sensor_zero_v"] == pytest.approx(0.215, abs=1e-3)
    assert found["encoder_zero_counts"] == 1000.0
    phases = [Phase(record.reference.phase) for record in homed.journal.ticks]
    began = phases.index(Phase.APPROACH)
    assert set(phases[:began]) == {Phase.HOMING}
    assert phases.count(Phase.APPROACH) == 500
    first = homed.journal.ticks[began]
    assert first.measurement.pressure_pa == pytest.approx(101.3e3, abs=2e3)
    assert first.estimate.error_rate_m_per_s == 0.0
    assert [tick for tick, event in homed.journal.events if event["event"] == "zeroed"][1] == began


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (("rig.sim.sensor_zero_v=0.45",), "outside 0.184 to 0.409 V"),
        (("rig.sim.sensor_zero_v=0.15",), "outside 0.184 to 0.409 V"),
        (("rig.homing.timeout_s=0.3", "rig.homing.steady_v=1e-6"), "still moving 0.3 s"),
    ],
)
def test_a_rig_that_cannot_be_homed_ends_with_code_4_and_the_reason(overrides, said):
    failed = homing(*overrides)
    assert failed.ending.code == ExitCode.SAFETY_TRIP == 4
    assert said in failed.ending.reason
    assert_left_safe(failed)
    assert {record.reference.phase for record in failed.journal.ticks} == {Phase.HOMING}


# --- faults ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["read_error", "device_lost"])
def test_a_failing_read_ends_with_code_69_at_the_safe_voltage(kind):
    ran = run(short(), fault(kind))
    assert ran.ending.code == ExitCode.UNAVAILABLE == 69
    assert f"{kind} injected at tick 2000" in ran.ending.reason
    assert_left_safe(ran)
    assert len(ran.journal.ticks) == 2000
    assert all(math.isfinite(record.outcome.applied_v) for record in ran.journal.ticks)


def test_a_failing_write_ends_with_code_69_and_its_tick_is_on_record():
    ran = run(short(), fault("write_error"))
    assert ran.ending.code == ExitCode.UNAVAILABLE
    assert "write_error injected at tick 2000" in ran.ending.reason
    assert_left_safe(ran)
    assert len(ran.journal.ticks) == 2001
    last = ran.journal.ticks[-1]
    assert last.timing.tick == 2000
    assert math.isnan(last.outcome.applied_v)
    assert math.isfinite(last.decision.valve_v)
    assert all(math.isfinite(record.outcome.applied_v) for record in ran.journal.ticks[:-1])


@pytest.mark.parametrize("kind", ["read_error", "write_error", "device_lost"])
def test_a_device_that_fails_in_the_first_tick_ends_safe_too(kind):
    ran = run(short(), fault(kind, from_tick=0))
    assert ran.ending.code == ExitCode.UNAVAILABLE
    assert_left_safe(ran)


def test_the_ending_is_told_once_the_valve_is_safe_and_before_the_device_is_released():
    settings = short()
    made, told = parts(settings, [fault("read_error", from_tick=5)]), []
    ending = loop.ControlLoop(
        rig=made.whole,
        clock=made.clock,
        **steered(settings, MemoryJournal()),
        supervisor=ScriptedSupervisor(),
        truth=lambda: loop.Truth(0.0, 0.0),
        ended=lambda ending: told.append((ending, made.rig.output_v, made.rig._is_open)),
    ).run()
    assert ending.code == ExitCode.UNAVAILABLE
    assert told == [(ending, pytest.approx(SAFE_OUTPUT_V, abs=AO_STEP_V), True)]


class Shut:
    """A device that cannot be opened."""

    def __init__(self, rig: Any) -> None:
        self._rig = rig

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    def open(self) -> None:
        raise RigError("no such device Dev1", fix="check the name", code=-200220)


def test_a_device_that_does_not_open_ends_with_code_69_and_its_own_words():
    ran = run(short(), wrap=Shut)
    assert ran.ending.code == ExitCode.UNAVAILABLE
    assert ran.ending.reason == "no such device Dev1 (device error -200220); check the name"
    assert_left_safe(ran)
    assert ran.journal.ticks == []


TRIPS = {
    "pressure_nan": (MEASUREMENT_NOT_FINITE, 1),
    "broken_wire": (SENSOR_RANGE, 21),
    "stale_sample": (STALE_SAMPLE, 2),
    "encoder_jump": (ENCODER_JUMP, 1),
    "stuck_encoder": (TRACKING_ERROR, 1200),
    "reversed_encoder": (TRACKING_ERROR | STROKE_LIMIT, 1200),
}


@pytest.mark.parametrize("kind", TRIPS)
def test_a_sensor_gone_bad_ends_with_code_4_and_the_reason(kind):
    bit, within = TRIPS[kind]
    ran = run(short(), fault(kind, from_tick=1600, size=-20_000))
    last = ran.journal.ticks[-1]
    assert ran.ending.code == ExitCode.SAFETY_TRIP == 4
    assert last.decision.tripped
    assert last.decision.verdicts & bit
    assert ran.ending.reason == "safety trip: " + "; ".join(
        explain_verdicts(last.decision.verdicts)
    )
    assert 1600 <= last.timing.tick < 1600 + within
    assert ran.journal.named("tripped") == [
        {"event": "tripped", "reasons": explain_verdicts(last.decision.verdicts)}
    ]
    assert not any(record.decision.tripped for record in ran.journal.ticks[:-1])
    # The tick that tripped already wrote the safe voltage.
    assert last.outcome.applied_v == pytest.approx(SAFE_OUTPUT_V, abs=AO_STEP_V / 2)
    assert_left_safe(ran)


@pytest.mark.parametrize("kind", ["stale_sample", "broken_wire"])
def test_a_sensor_that_is_bad_while_homing_trips_too(kind):
    ran = run(run_settings(*SHORT, *BENCH), fault(kind, from_tick=300))
    assert ran.ending.code == ExitCode.SAFETY_TRIP
    assert ran.journal.ticks[-1].reference.phase == Phase.HOMING
    assert_left_safe(ran)


# --- errors of our own -----------------------------------------------------------------


class Bug(Exception):
    pass


@pytest.mark.parametrize("raised", [Bug, KeyboardInterrupt])
def test_an_error_in_the_tick_is_raised_with_the_rig_already_safe(monkeypatch, raised):
    right, calls = run_ticks.step, []

    def wrong(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) > 500:
            raise raised("in the law")
        return right(*arguments)

    monkeypatch.setattr(run_ticks, "step", wrong)
    rigs: list[Any] = []
    with pytest.raises(raised, match="in the law"):
        run(short(), wrap=lambda rig: rigs.append(rig) or rig, plain=True)
    sim = rigs[0]._inner
    assert sim.output_v == pytest.approx(SAFE_OUTPUT_V, abs=AO_STEP_V / 2)
    with pytest.raises(RigError, match="not open"):
        sim.read()


class FullJournal(MemoryJournal):
    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        if len(self.ticks) == 700:
            raise OverflowError("the ring is full")
        super().put_row(row, late_s, missed)


def test_a_tick_that_cannot_be_kept_ends_the_run_safe():
    rigs: list[Any] = []
    with pytest.raises(OverflowError, match="ring is full"):
        run(short(), journal=FullJournal(), wrap=lambda rig: rigs.append(rig) or rig)
    assert rigs[0]._inner.output_v == pytest.approx(SAFE_OUTPUT_V, abs=AO_STEP_V / 2)


# --- stopped from outside --------------------------------------------------------------

INTERRUPTED = Ending(ExitCode.SIGINT, "stopped by SIGINT")


def test_the_first_signal_stops_smoothly_and_gives_its_exit_code():
    ran = run(short(), supervisor=ScriptedSupervisor(INTERRUPTED, stop_at=2000))
    assert ran.ending == INTERRUPTED
    assert ran.ending.code == 130
    phases = [record.reference.phase for record in ran.journal.ticks]
    assert phases[2000] == Phase.TRACK  # the tick is finished before it is asked
    assert phases[2001:] == [Phase.STOPPING] * (STOP_TICKS - 1)
    steps = [record.decision.valve_v for record in ran.journal.ticks[2000:]]
    # Some 4 V in 0.1 s, in equal steps: nothing jumps.
    assert max(abs(b - a) for a, b in pairwise(steps)) < 0.1
    assert ran.journal.named("stopping") == [{"event": "stopping", "reason": "stopped by SIGINT"}]
    assert_left_safe(ran)


def test_the_second_signal_stops_at_once():
    ran = run(short(), supervisor=ScriptedSupervisor(INTERRUPTED, stop_at=2000, abort_at=2030))
    assert ran.ending == INTERRUPTED
    assert ran.journal.ticks[-1].timing.tick == 2030
    assert_left_safe(ran)


def test_a_fault_during_the_stop_still_trips():
    supervisor = ScriptedSupervisor(INTERRUPTED, stop_at=2000)
    ran = run(short(), fault("pressure_nan", from_tick=2050), supervisor=supervisor)
    assert ran.ending.code == ExitCode.SAFETY_TRIP
    assert_left_safe(ran)


# --- missed ticks ----------------------------------------------------------------------


def test_missed_ticks_are_counted_and_the_measured_dt_is_used_and_tracking_goes_on():
    gaps = {at: 1 + n % 4 for n, at in enumerate(range(150, 4000, 170))}
    late = run(short(), missed=gaps)
    assert late.ending.code == ExitCode.OK
    records = late.journal.ticks
    lost = sum(record.timing.missed for record in records)
    assert lost > 30
    assert records[-1].timing.tick + 1 == len(records) + lost
    for before, record in pairwise(records):
        gap = record.timing.tick - before.timing.tick
        assert record.timing.missed == gap - 1
        assert record.timing.dt_s == pytest.approx(gap * 1e-3, abs=1e-12)
        assert record.raw.encoder_t_ns == record.timing.tick * MS
    tracked = late.journal.phase(Phase.TRACK)
    true_m = [record.truth.true_position_m - record.reference.reference_m for record in tracked]
    assert max(map(abs, true_m)) < 1.5e-3


# --- what the clock sees ---------------------------------------------------------------


class SlowClock:
    """A real grid in made-up time: a look at the clock costs 10 us, a wake is 30 us late."""

    period_ns = MS

    def __init__(self) -> None:
        self._now_ns = 0
        self._tick = -1

    def now_ns(self) -> int:
        self._now_ns += 10_000
        return self._now_ns

    def wall_offset_ns(self) -> int:
        return 0

    def wait(self, rehearse: Any = None) -> Any:
        self._tick += 1
        deadline_ns = (self._tick + 10) * MS
        self._now_ns = deadline_ns + 30_000
        return loop.Wake(self._tick, deadline_ns, self._now_ns, 0)


def test_a_record_says_how_late_the_tick_was_and_how_long_its_parts_took():
    settings = short(duration_s=0.1)
    made, journal, clock = parts(settings), MemoryJournal(), SlowClock()
    made.rig._now_ns = clock.now_ns
    ending = loop.ControlLoop(
        rig=made.whole,
        clock=clock,
        **steered(settings, journal),
        supervisor=ScriptedSupervisor(),
        truth=lambda: loop.Truth(0.0, 0.0),
    ).run()
    assert ending.code == ExitCode.OK
    for record in journal.ticks:
        assert record.timing.late_s == pytest.approx(30e-6)
        assert record.outcome.read_s == pytest.approx(20e-6)
        assert record.outcome.compute_s == pytest.approx(10e-6)
        assert record.outcome.write_s == pytest.approx(20e-6)
        assert record.timing.dt_s == pytest.approx(1e-3)
