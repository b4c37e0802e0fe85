"""Are the sensors alive and plausible, with nothing moved: volts, noise, creep."""

from __future__ import annotations

from collections.abc import Iterator

from pamctl.commissioning.doctor.findings import DoctorFinding, Level
from pamctl.commissioning.hands_on import Bench, SensorStatistics, summarise_samples

REST_S = 0.5
VENT_S = 1.0
_LOUD_V = 0.02
"""Some 3 kPa: ten times what a sound MPX5700 and its wire give."""
_JUMP_COUNTS = 50
BY_HAND_COUNTS = 300
"""A millimetre."""


def measure_at_rest(bench: Bench) -> SensorStatistics:
    """Leave the rig at its safe voltage until it should be at rest, then listen.

    Without the bench's limits: what they would complain of is what is to be found.
    """
    bench.hold_unwatched(bench.safe_valve_v, VENT_S)
    return summarise_samples(bench.hold_unwatched(bench.safe_valve_v, REST_S))


def judge_sensors(bench: Bench, rest: SensorStatistics) -> Iterator[DoctorFinding]:
    """Judge what was heard at rest."""
    yield judge_voltage(bench, rest)
    yield judge_noise(bench, rest)
    yield judge_encoder_at_rest(bench, rest)


def is_in_range(bench: Bench, rest: SensorStatistics) -> bool:
    """Tell whether the sensor's voltage is one that a connected sensor can give."""
    return bench.limits.sensor_low_v <= rest.sensor_v <= bench.limits.sensor_high_v


def judge_voltage(bench: Bench, rest: SensorStatistics) -> DoctorFinding:
    """See whether the pressure sensor is there, and says what a vented muscle should."""
    limits, cal, name = bench.limits, bench.settings, "sensor.voltage"
    absolute_pa = bench.pressure_pa(rest.sensor_v)
    data = {"sensor_v": rest.sensor_v, "pressure_pa": absolute_pa, "noise_v": rest.noise_v}
    found = f"{rest.sensor_v:.3f} V"
    if not is_in_range(bench, rest):
        wanted = f"{limits.sensor_low_v:g} to {limits.sensor_high_v:g} V, whatever the pressure"
        fix = (
            "a broken wire, no 5 V supply, or another channel: check nidaq.pressure_channel and "
            "nidaq.terminal, and measure the sensor's output with a voltmeter"
        )
        return DoctorFinding(name, "fault", found, wanted, fix, data)
    found += f", {bench.gauge_kpa(absolute_pa):.1f} kPa gauge"
    if not bench.vents_when_safe:
        held = f"{found}; the safe voltage holds the air, so it cannot be judged"
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
    """See how quiet the pressure sensor is."""
    noise_pa = rest.noise_v * bench.settings.sensor_pa_per_v
    level: Level = "ok" if rest.noise_v <= _LOUD_V else "warning"
    return DoctorFinding(
        "sensor.noise",
        level,
        f"{rest.noise_v * 1e3:.2f} mV, {noise_pa:.0f} Pa, of {rest.samples} samples",
        f"below {_LOUD_V * 1e3:.0f} mV at rest",
        "check nidaq.terminal (rse or nrse), the cable's shield and its distance to motors",
        {"noise_v": rest.noise_v, "noise_pa": noise_pa},
    )


def judge_encoder_at_rest(bench: Bench, rest: SensorStatistics) -> DoctorFinding:
    """See that the encoder stands still while the muscle does."""
    span, jump = rest.counts_span, rest.counts_jump
    data = {"span_counts": span, "jump_counts": jump, "mean_counts": rest.counts}
    found = f"over {span} counts in {rest.samples} samples, {jump} at once"
    wanted = f"at most {bench.homing.steady_counts} at rest"
    if jump >= _JUMP_COUNTS:
        fix = "a loose or unshielded A or B line: check plugs and shield; nidaq.encoder_filter_ns"
        return DoctorFinding("encoder.rest", "fault", found, wanted, fix, data)
    if span > bench.homing.steady_counts:
        fix = "is the muscle still moving, or the carriage touched? Then a loose reading head"
        return DoctorFinding("encoder.rest", "warning", found, wanted, fix, data)
    return DoctorFinding("encoder.rest", "ok", found, data=data)


def report_unmoved_encoder() -> DoctorFinding:
    """Say what nobody can know of an encoder that was not moved."""
    return DoctorFinding(
        "encoder.alive",
        "warning",
        "not known: an unplugged encoder stands as still as this one",
        "counts that follow the carriage",
        "run `pamctl doctor` at a terminal and move the carriage when asked, or add --actuate",
    )


def judge_hand_motion(counts: int) -> DoctorFinding:
    """Judge what the encoder made of a motion by hand."""
    alive = counts >= BY_HAND_COUNTS
    return DoctorFinding(
        "encoder.alive",
        "ok" if alive else "fault",
        f"moved by hand over {counts} counts",
        f"at least {BY_HAND_COUNTS}, for a millimetre or more",
        "check the encoder's plug, its 5 V supply, A and B lines, and nidaq.encoder_counter",
        {"counts": counts},
    )
