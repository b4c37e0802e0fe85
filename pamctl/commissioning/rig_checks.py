"""Checks of the rig: sensors alive and plausible at rest; valve and encoder that follow a pulse.

Only `pulse_valve` moves anything: one short pulse each way, like homing's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from hal.backend import DoctorFinding, Level
from hal.rig import RawSample
from pamctl.commissioning.bench import Bench, LimitError, SensorStatistics, summarise_samples

REST_S = 0.5
VENT_S = 1.0
_LOUD_V = 0.02
"""Some 3 kPa: ten times the noise of a sound MPX5700 and its wire."""
_DRIFT_V = 0.005
"""Some 0.8 kPa within the half second at rest: no vented muscle changes its pressure so."""
OPEN_INPUT = (
    "an open input floats, and reads a plausible voltage, where no pull-down of 100 kOhm from the "
    "input to AI GND is fitted"
)
_JUMP_COUNTS = 50
BY_HAND_COUNTS = 300
"""A millimetre."""


def measure_at_rest(bench: Bench) -> SensorStatistics:
    """Leave the rig at its safe voltage until it should be at rest, then sample it.

    The bench's limits are off here, because the checks look for what a limit would stop.
    """
    bench.hold_unwatched(bench.safe_valve_v, VENT_S)
    return summarise_samples(bench.hold_unwatched(bench.safe_valve_v, REST_S))


def judge_sensors(bench: Bench, rest: SensorStatistics) -> Iterator[DoctorFinding]:
    """Judge the sensors at rest."""
    yield judge_voltage(bench, rest)
    yield judge_noise(bench, rest)
    yield judge_encoder_at_rest(bench, rest)


def is_in_range(bench: Bench, rest: SensorStatistics) -> bool:
    """Say whether a connected sensor can give this voltage."""
    return bench.limits.sensor_low_v <= rest.sensor_v <= bench.limits.sensor_high_v


def judge_voltage(bench: Bench, rest: SensorStatistics) -> DoctorFinding:
    """Check that the pressure sensor is connected and reads what a vented muscle should."""
    limits, cal, name = bench.limits, bench.settings, "sensor.voltage"
    absolute_pa = bench.pressure_pa(rest.sensor_v)
    data = {"sensor_v": rest.sensor_v, "pressure_pa": absolute_pa, "noise_v": rest.noise_v}
    found = f"{rest.sensor_v:.3f} V"
    if not is_in_range(bench, rest):
        wanted = f"{limits.sensor_low_v:g} to {limits.sensor_high_v:g} V, whatever the pressure"
        fix = (
            "a broken wire, no 5 V supply, or another channel: measure the sensor's output with a "
            f"voltmeter{bench.point_to(bench.keys.pressure_input, bench.keys.pressure_wiring)}"
        )
        return DoctorFinding(name, "fault", found, wanted, fix, data)
    found += f", {bench.gauge_kpa(absolute_pa):.1f} kPa gauge"
    if not bench.vents_when_safe:
        held = f"{found}; the safe voltage holds the air, so the zero cannot be checked"
        return DoctorFinding(name, "ok", held, data=data)
    if cal.sensor_zero_lowest_v <= rest.sensor_v <= cal.sensor_zero_highest_v:
        return DoctorFinding(name, "ok", f"{found}, vented", data=data)
    wanted = f"{cal.sensor_zero_lowest_v:g} to {cal.sensor_zero_highest_v:g} V when vented"
    fix = (
        "the safe voltage does not vent: is the valve reversed, the exhaust blocked, or "
        "safe_volts wrong? Turn the regulator down, then try `pamctl doctor --actuate`"
        if rest.sensor_v > cal.sensor_zero_highest_v
        else "check the sensor's 5 V supply and its type (gauge, not vacuum)"
    )
    return DoctorFinding(name, "fault", f"{found} at the safe voltage", wanted, fix, data)


def judge_noise(bench: Bench, rest: SensorStatistics) -> DoctorFinding:
    """Check the noise of the pressure sensor."""
    noise_pa = rest.noise_v * bench.settings.sensor_pa_per_v
    stands_still = rest.counts_span <= bench.homing.steady_counts
    if abs(rest.drift_v) > _DRIFT_V and stands_still and bench.vents_when_safe:
        fix = f"is the sensor's wire broken? {OPEN_INPUT[0].upper()}{OPEN_INPUT[1:]}"
        return DoctorFinding(
            "sensor.noise",
            "warning",
            f"the voltage drifts by {rest.drift_v * 1e3:+.0f} mV while the muscle stands still",
            f"below {_DRIFT_V * 1e3:.0f} mV at rest",
            f"{fix}{bench.point_to(bench.keys.pressure_input, bench.keys.pressure_wiring)}",
            {"noise_v": rest.noise_v, "noise_pa": noise_pa, "drift_v": rest.drift_v},
        )
    level: Level = "ok" if rest.noise_v <= _LOUD_V else "warning"
    return DoctorFinding(
        "sensor.noise",
        level,
        f"{rest.noise_v * 1e3:.2f} mV, {noise_pa:.0f} Pa, of {rest.samples} samples",
        f"below {_LOUD_V * 1e3:.0f} mV at rest",
        "check the sensor's ground, the cable's shield and its distance to motors"
        f"{bench.point_to(bench.keys.pressure_wiring)}",
        {"noise_v": rest.noise_v, "noise_pa": noise_pa},
    )


def judge_encoder_at_rest(bench: Bench, rest: SensorStatistics) -> DoctorFinding:
    """Check that the encoder stands still while the muscle does."""
    span, jump = rest.counts_span, rest.counts_jump
    data = {"span_counts": span, "jump_counts": jump, "mean_counts": rest.counts}
    found = f"{span} counts from lowest to highest in {rest.samples} samples, {jump} at once"
    wanted = f"at most {bench.homing.steady_counts} at rest"
    if jump >= _JUMP_COUNTS:
        fix = "a loose or unshielded A or B line: check plugs and shield"
        fix += bench.point_to(bench.keys.encoder_filter)
        return DoctorFinding("encoder.rest", "fault", found, wanted, fix, data)
    if span > bench.homing.steady_counts:
        fix = "is the muscle still moving, or is the carriage touched? If not: a loose reading head"
        return DoctorFinding("encoder.rest", "warning", found, wanted, fix, data)
    return DoctorFinding("encoder.rest", "ok", found, data=data)


def report_unmoved_encoder() -> DoctorFinding:
    """Say that an encoder that was not moved cannot be checked."""
    return DoctorFinding(
        "encoder.alive",
        "warning",
        "not checked: an unplugged encoder stands still as well",
        "counts that follow the carriage",
        "run `pamctl doctor` at a terminal and move the carriage when asked, or add --actuate",
    )


def judge_hand_motion(bench: Bench, counts: int) -> DoctorFinding:
    """Judge how the encoder counted a motion by hand."""
    alive = counts >= BY_HAND_COUNTS
    return DoctorFinding(
        "encoder.alive",
        "ok" if alive else "fault",
        f"moved by hand over {counts} counts",
        f"at least {BY_HAND_COUNTS}, for a millimetre or more",
        "check the encoder's plug, its 5 V supply, and its A and B lines"
        f"{bench.point_to(bench.keys.encoder_input)}",
        {"counts": counts},
    )


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
