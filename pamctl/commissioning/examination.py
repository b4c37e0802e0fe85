"""All checks of `pamctl doctor`, from the PC to the muscle."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

from hal.backend import DoctorFinding, ProbeRequest, report_rig_error
from hal.rig import RigError
from pamctl.commissioning.bench import Bench, NoAnswer, Terminal, open_workplace
from pamctl.commissioning.pc_checks import (
    examine_pc,
    judge_calls,
    judge_permissions,
    judge_rate,
    judge_wake_ups,
    measure_calls,
    measure_wake_ups,
)
from pamctl.commissioning.rig_checks import (
    BY_HAND_COUNTS,
    examine_actuation,
    is_in_range,
    judge_hand_motion,
    judge_sensors,
    measure_at_rest,
    report_unmoved_encoder,
)
from pamctl.processes.backends import SHARED_MEMORY, build_clock, hold_device
from pamctl.realtime.scheduling import prepare
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_runner import rehearse_tick_s
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import RunSettings

CountsByHand = Callable[[Bench], int | None]
"""Asks for the carriage to be moved; returns how many counts it moved over, None if not asked."""


def examine_all(
    settings: RunSettings, rt_seconds: float, *, actuate: bool, may_ask: bool
) -> Generator[DoctorFinding, None, None]:
    """Check everything, from the PC to the muscle."""
    yield from examine_pc(SHARED_MEMORY, Path("logs"))
    yield from _measure_timing(settings, rt_seconds)
    probe, request = settings.rig.record.probe, make_probe_request(settings)
    if probe is not None:
        can_open = True
        for finding in probe.examine(request):
            yield finding
            can_open &= finding.level != "fault" or finding.name not in probe.required
        if not can_open:
            return
    try:
        with open_workplace(settings) as bench:
            yield from _examine_rig(
                bench,
                build_tick_setup(settings),
                actuate=actuate,
                by_hand=_ask_for_motion if may_ask else lambda bench: None,
                loop_cpu=settings.rig.loop.cpu,
            )
        if probe is not None and probe.examine_clock is not None:
            with hold_device(settings):
                yield probe.examine_clock(request)
        if probe is not None and probe.examine_output is not None:
            with hold_device(settings):
                yield from probe.examine_output(request)
    except RigError as error:
        yield report_rig_error("rig.device", error, "the device, for this command alone")


def _examine_rig(
    bench: Bench, setup: TickSetup, *, actuate: bool, by_hand: CountsByHand, loop_cpu: int | None
) -> Iterator[DoctorFinding]:
    """Check sensors and calls at the safe voltage; with `actuate`, move the muscle as well."""
    with prepare("auto", loop_cpu):  # as a run's loop makes these calls
        calls = measure_calls(bench.rig, bench.safe_volts)
        rehearsed_s = rehearse_tick_s(setup, bench.period_s)
    yield from judge_calls(calls, bench.period_s)
    yield judge_rate(calls, rehearsed_s, bench.period_s)
    rest = measure_at_rest(bench)
    yield from judge_sensors(bench, rest)
    if not actuate:
        counts = by_hand(bench)
        yield report_unmoved_encoder() if counts is None else judge_hand_motion(bench, counts)
    elif is_in_range(bench, rest):
        yield from examine_actuation(bench)
    else:
        yield DoctorFinding(
            "valve.sign",
            "fault",
            "not tried: without a pressure sensor the pressure cannot be watched",
            "a pressure sensor within its range",
            "see sensor.voltage, then run this again",
        )


def make_probe_request(settings: RunSettings) -> ProbeRequest[Any]:
    """Return what the device of a run is checked against."""
    rig = settings.rig
    limits, cal = rig.limits, rig.calibration
    highest_v = (
        cal.sensor_zero_v + (limits.pressure_pa - cal.atmospheric_pressure_pa) / cal.sensor_pa_per_v
    )
    return ProbeRequest(
        settings=rig.device_settings,
        safe_volts=rig.safe_volts,
        rate_hz=rig.loop.rate_hz,
        sensor_range_v=(limits.sensor_low_v, max(limits.sensor_high_v, highest_v)),
        sensor_pa_per_v=cal.sensor_pa_per_v,
    )


def _measure_timing(settings: RunSettings, rt_seconds: float) -> Iterator[DoctorFinding]:
    """Measure the loop's clock as an ordinary program, then with all that is permitted."""
    period_s = 1.0 / settings.rig.loop.rate_hz
    plain = measure_wake_ups(build_clock(settings, may_spin=False), rt_seconds)
    with prepare("auto", settings.rig.loop.cpu) as preparation:
        permitted = tuple(judge_permissions(preparation))
        how = "SCHED_FIFO" if preparation.fifo else "no SCHED_FIFO"
        if preparation.may_spin:
            how += f", spinning {settings.rig.loop.spin_us:g} us"
        clock = build_clock(settings, may_spin=preparation.may_spin)
        prepared = measure_wake_ups(clock, rt_seconds)
    yield from permitted
    yield judge_wake_ups("pc.wakeup", prepared, period_s, how)
    # For comparison only: a run is scheduled like this with `--rt off`.
    plainly = judge_wake_ups("pc.wakeup_plain", plain, period_s, "as an ordinary program")
    yield plainly._replace(level="ok")


def _ask_for_motion(bench: Bench) -> int | None:
    """Ask for the carriage to be moved; return how many counts it moved over."""
    terminal, counts = Terminal(), list[int]()

    def watch() -> None:
        counts.extend(s.encoder_counts for s in bench.hold_unwatched(bench.safe_valve_v, 0.02))

    request = (
        f"move the carriage by hand, by a millimetre ({BY_HAND_COUNTS} counts) or more, and back"
    )
    watch()  # before the question, and once more after the answer
    try:
        done = terminal.confirm_done(request, watch)
    except NoAnswer:
        return None
    watch()
    return max(counts) - min(counts) if done else None
