"""All that is found out over an open rig, in the order in which it makes sense."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from hal.rig import RigError
from pamctl.commissioning.doctor.actuate import actuation_findings
from pamctl.commissioning.doctor.findings import Finding, told
from pamctl.commissioning.doctor.latency import call_findings, measured_calls
from pamctl.commissioning.doctor.sensors import (
    is_in_range,
    moved_by_hand,
    never_moved,
    resting,
    sensor_findings,
)
from pamctl.commissioning.hands_on import Bench
from pamctl.realtime.scheduling import prepare

CountsByHand = Callable[[Bench], int | None]
"""Asks for the carriage to be moved; returns over how many counts it went, None unasked."""


def rig_findings(
    bench: Bench, *, actuate: bool, by_hand: CountsByHand, loop_cpu: int | None
) -> Iterator[Finding]:
    """Look at sensors and calls at the safe voltage; move the muscle where that is wanted."""
    with prepare("auto", loop_cpu):  # as a run's loop makes these calls
        calls = measured_calls(bench.rig, bench.safe_volts)
    yield from call_findings(calls, bench.period_s)
    rest = resting(bench)
    yield from sensor_findings(bench, rest)
    if not actuate:
        counts = by_hand(bench)
        yield never_moved() if counts is None else moved_by_hand(counts)
    elif is_in_range(bench, rest):
        yield from actuation_findings(bench)
    else:
        yield Finding(
            "valve.sign",
            "fault",
            "not tried: with a sensor that is not there the pressure could not be watched",
            "a pressure sensor within its range",
            "see sensor.voltage, then run this again",
        )


def unavailable(error: RigError) -> Finding:
    """Say that the rig could not be had, or was lost on the way."""
    return Finding(
        "rig.device", "fault", told(error), "the device, for this command alone", error.fix
    )
