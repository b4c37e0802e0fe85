"""The checks of an open rig, in the order in which they make sense."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from hal.doctor_finding import DoctorFinding, describe_rig_error
from hal.rig import RigError
from pamctl.commissioning.doctor.actuate import examine_actuation
from pamctl.commissioning.doctor.latency import judge_calls, judge_rate, measure_calls
from pamctl.commissioning.doctor.sensors import (
    is_in_range,
    judge_hand_motion,
    judge_sensors,
    measure_at_rest,
    report_unmoved_encoder,
)
from pamctl.commissioning.hands_on import Bench
from pamctl.realtime.scheduling import prepare
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_cost import rehearse_tick_s

CountsByHand = Callable[[Bench], int | None]
"""Asks for the carriage to be moved; returns how many counts it moved over, None if not asked."""


def examine_rig(
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


def report_unavailable_rig(error: RigError) -> DoctorFinding:
    """Say that the rig is not available, or was lost on the way."""
    return DoctorFinding(
        "rig.device",
        "fault",
        describe_rig_error(error),
        "the device, for this command alone",
        error.fix,
    )
