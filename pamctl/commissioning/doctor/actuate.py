"""Does the valve follow its command, and does the encoder see the muscle move?

This is the only part of the doctor that moves anything: one short pulse each way, like homing's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from hal.doctor_finding import DoctorFinding
from hal.rig import RawSample
from pamctl.commissioning.doctor.sensors import OPEN_INPUT
from pamctl.commissioning.hands_on import Bench, LimitError, SensorStatistics, summarise_samples

_END_SAMPLES = 5


class PulseResponse(NamedTuple):
    """What a pulse changed, as the sensors show it."""

    rise_v: float
    """Change of the pressure sensor's voltage."""
    counts: float
    """Change of the encoder; positive is contraction by the file's `encoder_sign`."""


class ActuationResponse(NamedTuple):
    """What the rig did when asked to fill, and then to exhaust."""

    fill: PulseResponse
    exhaust: PulseResponse


def pulse_valve(bench: Bench) -> ActuationResponse:
    """Fill briefly, then exhaust briefly. Raises `LimitError`."""
    homing, sign = bench.homing, bench.settings.encoder_sign
    begin = bench.settle(bench.safe_valve_v, 0.1)
    top = _average_end(bench.hold(homing.fill_v, homing.fill_s))
    bottom = _average_end(bench.hold(-homing.fill_v, homing.fill_s))
    bench.hold(bench.safe_valve_v, bench.period_s)
    return ActuationResponse(
        PulseResponse(top.sensor_v - begin.sensor_v, sign * (top.counts - begin.counts)),
        PulseResponse(bottom.sensor_v - top.sensor_v, sign * (bottom.counts - top.counts)),
    )


def examine_actuation(bench: Bench) -> Iterator[DoctorFinding]:
    """Move the muscle and judge what it did."""
    try:
        answer = pulse_valve(bench)
    except LimitError as error:
        fix = "repair that first; valve and encoder could not be checked"
        yield DoctorFinding("valve.sign", "fault", f"stopped: {error}", "within the limits", fix)
        return
    yield judge_valve_sign(bench, answer)
    yield judge_encoder_motion(bench, answer)


def judge_valve_sign(bench: Bench, answer: ActuationResponse) -> DoctorFinding:
    """Check that filling raises the pressure and exhausting lowers it."""
    name, (fill, exhaust), least_v = "valve.sign", answer, _least_v(bench)
    data = {"fill_rise_v": fill.rise_v, "exhaust_rise_v": exhaust.rise_v}
    volts, seconds = bench.homing.fill_v, bench.homing.fill_s
    found = (
        f"+{volts:g} V for {seconds:g} s changed the sensor by {fill.rise_v:+.3f} V, "
        f"-{volts:g} V by {exhaust.rise_v:+.3f} V"
    )
    wanted = f"a rise, then a fall, of {least_v:g} V or more"
    fills, exhausts = fill.rise_v >= least_v, exhaust.rise_v <= -least_v
    if fills and exhausts:
        return DoctorFinding(name, "ok", found, data=data)
    if fill.rise_v <= -least_v and exhaust.rise_v >= least_v:
        fix = (
            "THE VALVE IS REVERSED, and the safe voltage fills. Shut the supply off; swap the "
            "valve's ports or the driver's polarity, and run this again before anything else"
        )
        return DoctorFinding(name, "fault", f"reversed: {found}", wanted, fix, data)
    if fills:
        fix = "it filled, but did not exhaust: a blocked exhaust, or a null that is far off"
    elif exhausts:
        fix = "it exhausted, but did not fill: was the muscle full already? check supply and null"
    elif abs(fill.counts) >= bench.homing.fill_counts:
        fix = "the muscle moved, but the sensor's voltage did not follow: check its wire; "
        fix += OPEN_INPUT
        fix += bench.point_to(bench.keys.pressure_input)
    else:
        fix = (
            "open the supply; check the driver's power and its command wire, and with a voltmeter "
            f"that the output follows{bench.point_to(bench.keys.valve_output)}"
        )
    return DoctorFinding(name, "fault", found, wanted, fix, data)


def judge_encoder_motion(bench: Bench, answer: ActuationResponse) -> DoctorFinding:
    """Check that the count grows with contraction, which follows from more pressure."""
    name, least = "encoder.alive", bench.homing.fill_counts
    pulse = max(answer, key=lambda pulse: abs(pulse.rise_v))
    data = {"fill_counts": answer.fill.counts, "exhaust_counts": answer.exhaust.counts}
    found = f"{answer.fill.counts:+.0f} counts on fill, {answer.exhaust.counts:+.0f} on exhaust"
    wanted = f"at least {least} counts, positive where the pressure rises"
    if max(abs(pulse.counts) for pulse in answer) < least:
        if abs(pulse.rise_v) < _least_v(bench):
            fix = "the pressure did not change either: repair the valve first"
            return DoctorFinding(name, "warning", f"not checked: {found}", wanted, fix, data)
        fix = (
            "unplugged? check the encoder's plug, its 5 V supply, its A and B lines, and that the "
            f"carriage is coupled{bench.point_to(bench.keys.encoder_input)}"
        )
        return DoctorFinding(name, "fault", found, wanted, fix, data)
    if pulse.counts * pulse.rise_v < 0:
        sign = -bench.settings.encoder_sign
        fix = f"set calibration.encoder_sign to {sign} in the rig file, or swap A and B"
        return DoctorFinding(name, "fault", f"reversed: {found}", wanted, fix, data)
    return DoctorFinding(name, "ok", found, data=data)


def _least_v(bench: Bench) -> float:
    # Zero switches the check off in homing; here a limit is needed all the same.
    return bench.homing.fill_rise_v or 0.02


def _average_end(samples: Sequence[RawSample]) -> SensorStatistics:
    return summarise_samples(samples[-_END_SAMPLES:])
