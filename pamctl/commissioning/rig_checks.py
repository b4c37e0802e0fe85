"""All checks of `pamctl doctor`, from the PC to the muscle; those of the rig stand here.

Sensors alive and plausible at rest; valve and encoder that follow a pulse. Only `pulse_valve`
moves anything: one short pulse each way, like homing's.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from hal.backend import ProbeRequest, report_check, report_rig_error
from hal.problem import Level, Problem
from hal.rig import RigError
from pamctl.base.texts import count_of
from pamctl.commissioning.bench import (
    Bench,
    LimitError,
    NoAnswer,
    SensorStatistics,
    Terminal,
    open_workplace,
    summarise_samples,
)
from pamctl.commissioning.pc_checks import (
    examine_pc,
    judge_calls,
    judge_permissions,
    judge_rate,
    judge_wake_ups,
    measure_calls,
    measure_wake_ups,
)
from pamctl.processes.backends import SHARED_MEMORY, build_clock, hold_device
from pamctl.realtime.scheduling import prepare
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_runner import rehearse_tick_s
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import RunSettings

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


def judge_sensors(bench: Bench, rest: SensorStatistics) -> Iterator[Problem]:
    """Judge the sensors at rest."""
    yield judge_voltage(bench, rest)
    yield judge_noise(bench, rest)
    yield judge_encoder_at_rest(bench, rest)


def is_in_range(bench: Bench, rest: SensorStatistics) -> bool:
    """Say whether a connected sensor can give this voltage."""
    return bench.limits.sensor_low_v <= rest.sensor_v <= bench.limits.sensor_high_v


def judge_voltage(bench: Bench, rest: SensorStatistics) -> Problem:
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
        return report_check(name, "fault", found, wanted, fix, data)
    found += f", {bench.gauge_kpa(absolute_pa):.1f} kPa gauge"
    if not bench.vents_when_safe:
        held = f"{found}; the safe voltage holds the air, so the zero cannot be checked"
        return report_check(name, "ok", held, data=data)
    if cal.sensor_zero_lowest_v <= rest.sensor_v <= cal.sensor_zero_highest_v:
        return report_check(name, "ok", f"{found}, vented", data=data)
    wanted = f"{cal.sensor_zero_lowest_v:g} to {cal.sensor_zero_highest_v:g} V when vented"
    fix = (
        "the safe voltage does not vent: is the valve reversed, the exhaust blocked, or "
        "safe_volts wrong? Turn the regulator down, then try `pamctl doctor --actuate`"
        if rest.sensor_v > cal.sensor_zero_highest_v
        else "check the sensor's 5 V supply and its type (gauge, not vacuum)"
    )
    return report_check(name, "fault", f"{found} at the safe voltage", wanted, fix, data)


def judge_noise(bench: Bench, rest: SensorStatistics) -> Problem:
    """Check the noise of the pressure sensor."""
    noise_pa = rest.noise_v * bench.settings.sensor_pa_per_v
    stands_still = rest.counts_span <= bench.homing.steady_counts
    if abs(rest.drift_v) > _DRIFT_V and stands_still and bench.vents_when_safe:
        fix = f"is the sensor's wire broken? {OPEN_INPUT[0].upper()}{OPEN_INPUT[1:]}"
        return report_check(
            "sensor.noise",
            "warning",
            f"the voltage drifts by {rest.drift_v * 1e3:+.0f} mV while the muscle stands still",
            f"below {_DRIFT_V * 1e3:.0f} mV at rest",
            f"{fix}{bench.point_to(bench.keys.pressure_input, bench.keys.pressure_wiring)}",
            {"noise_v": rest.noise_v, "noise_pa": noise_pa, "drift_v": rest.drift_v},
        )
    level: Level = "ok" if rest.noise_v <= _LOUD_V else "warning"
    return report_check(
        "sensor.noise",
        level,
        f"{rest.noise_v * 1e3:.2f} mV, {noise_pa:.0f} Pa, of {rest.samples} samples",
        f"below {_LOUD_V * 1e3:.0f} mV at rest",
        "check the sensor's ground, the cable's shield and its distance to motors"
        f"{bench.point_to(bench.keys.pressure_wiring)}",
        {"noise_v": rest.noise_v, "noise_pa": noise_pa},
    )


def judge_encoder_at_rest(bench: Bench, rest: SensorStatistics) -> Problem:
    """Check that the encoder stands still while the muscle does."""
    span, jump = rest.counts_span, rest.counts_jump
    data = {"span_counts": span, "jump_counts": jump, "mean_counts": rest.counts}
    found = f"{count_of(span, 'count')} in {rest.samples} samples, {jump} at once"
    wanted = f"at most {bench.homing.steady_counts} at rest"
    level: Level = "warning" if span > bench.homing.steady_counts else "ok"
    fix = "is the muscle still moving, or is the carriage touched? If not: a loose reading head"
    if jump >= _JUMP_COUNTS:
        level, fix = "fault", "a loose or unshielded A or B line: check plugs and shield"
        fix += bench.point_to(bench.keys.encoder_filter)
    return report_check("encoder.rest", level, found, wanted, fix, data)


def judge_hand_motion(bench: Bench, counts: int | None) -> Problem:
    """Judge how the encoder counted a motion by hand; one that was not moved is not checked."""
    if counts is None:
        return report_check(
            "encoder.alive",
            "warning",
            "not checked: an unplugged encoder stands still as well",
            "counts that follow the carriage",
            "run `pamctl doctor` at a terminal and move the carriage when asked, or add --actuate",
        )
    alive = counts >= BY_HAND_COUNTS
    return report_check(
        "encoder.alive",
        "ok" if alive else "fault",
        f"moved by hand over {count_of(counts, 'count')}",
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
    top = summarise_samples(bench.hold(homing.fill_v, homing.fill_s)[-_END_SAMPLES:])
    bottom = summarise_samples(bench.hold(-homing.fill_v, homing.fill_s)[-_END_SAMPLES:])
    bench.hold(bench.safe_valve_v, bench.period_s)
    return ActuationResponse(
        PulseResponse(top.sensor_v - begin.sensor_v, sign * (top.counts - begin.counts)),
        PulseResponse(bottom.sensor_v - top.sensor_v, sign * (bottom.counts - top.counts)),
    )


def examine_actuation(bench: Bench) -> Iterator[Problem]:
    """Move the muscle and judge what it did."""
    try:
        answer = pulse_valve(bench)
    except LimitError as error:
        fix = "repair that first; valve and encoder could not be checked"
        yield report_check("valve.sign", "fault", f"stopped: {error}", "within the limits", fix)
        return
    yield judge_valve_sign(bench, answer)
    yield judge_encoder_motion(bench, answer)


def judge_valve_sign(bench: Bench, answer: ActuationResponse) -> Problem:
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
        return report_check(name, "ok", found, data=data)
    if fill.rise_v <= -least_v and exhaust.rise_v >= least_v:
        found = f"reversed: {found}"
        fix = (
            "THE VALVE IS REVERSED, and the safe voltage fills. Shut the supply off; swap the "
            "valve's ports or the driver's polarity, and run this again before anything else"
        )
    elif fills:
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
    return report_check(name, "fault", found, wanted, fix, data)


def judge_encoder_motion(bench: Bench, answer: ActuationResponse) -> Problem:
    """Check that the count grows with contraction, which follows from more pressure."""
    name, least = "encoder.alive", bench.homing.fill_counts
    pulse = max(answer, key=lambda pulse: abs(pulse.rise_v))
    data = {"fill_counts": answer.fill.counts, "exhaust_counts": answer.exhaust.counts}
    found = f"{answer.fill.counts:+.0f} counts on fill, {answer.exhaust.counts:+.0f} on exhaust"
    wanted = f"at least {least} counts, positive where the pressure rises"
    if max(abs(pulse.counts) for pulse in answer) < least:
        if abs(pulse.rise_v) < _least_v(bench):
            fix = "the pressure did not change either: repair the valve first"
            return report_check(name, "warning", f"not checked: {found}", wanted, fix, data)
        fix = (
            "unplugged? check the encoder's plug, its 5 V supply, its A and B lines, and that the "
            f"carriage is coupled{bench.point_to(bench.keys.encoder_input)}"
        )
        return report_check(name, "fault", found, wanted, fix, data)
    if pulse.counts * pulse.rise_v < 0:
        sign = -bench.settings.encoder_sign
        fix = f"set calibration.encoder_sign to {sign} in the rig file, or swap A and B"
        return report_check(name, "fault", f"reversed: {found}", wanted, fix, data)
    return report_check(name, "ok", found, data=data)


def _least_v(bench: Bench) -> float:
    # Zero switches the check off in homing; here a limit is needed all the same.
    return bench.homing.fill_rise_v or 0.02


# --- all of them -------------------------------------------------------------------------------


def examine_all(
    settings: RunSettings, rt_seconds: float, *, actuate: bool, may_ask: bool
) -> Generator[Problem, None, None]:
    """Check everything, from the PC to the muscle."""
    yield from examine_pc(SHARED_MEMORY, Path("logs"))
    yield from _measure_timing(settings, rt_seconds)
    probe, request = settings.rig.record.probe, make_probe_request(settings)
    if probe is not None:
        can_open = True
        for finding in probe.examine(request):
            yield finding
            can_open &= finding.level != "fault" or finding.key not in probe.required
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
            with hold_device(settings.rig):
                yield probe.examine_clock(request)
        if probe is not None and probe.examine_output is not None:
            with hold_device(settings.rig):
                yield from probe.examine_output(request)
    except RigError as error:
        yield report_rig_error("rig.device", error, "the device, for this command alone")


def _examine_rig(
    bench: Bench,
    setup: TickSetup,
    *,
    actuate: bool,
    by_hand: Callable[[Bench], int | None],
    loop_cpu: int | None,
) -> Iterator[Problem]:
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
        yield judge_hand_motion(bench, counts)
    elif is_in_range(bench, rest):
        yield from examine_actuation(bench)
    else:
        yield report_check(
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


def _measure_timing(settings: RunSettings, rt_seconds: float) -> Iterator[Problem]:
    """Measure the loop's clock with all that is permitted."""
    period_s = 1.0 / settings.rig.loop.rate_hz
    with prepare("auto", settings.rig.loop.cpu) as preparation:
        permitted = tuple(judge_permissions(preparation))
        how = "SCHED_FIFO" if preparation.fifo else "no SCHED_FIFO"
        if preparation.may_spin:
            how += f", spinning {settings.rig.loop.spin_us:g} us"
        clock = build_clock(settings, may_spin=preparation.may_spin)
        prepared = measure_wake_ups(clock, rt_seconds)
    yield from permitted
    yield judge_wake_ups("pc.wakeup", prepared, period_s, how)


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
