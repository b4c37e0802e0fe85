"""What is doubtful about a record: its times, its units, its sensors, and whose record it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from pamctl.base.errors import Problem
from pamctl.base.texts import count_of
from pamctl.diagnose.record import CHANNELS, Array, Record, estimate_white_noise
from pamctl.diagnose.time_shifts import check_time_shifts, find_usual_ends
from pamctl.log.importing.command_range import is_switched
from pamctl.log.record_problems import find_record_problems, find_sensor_step, measured_columns
from pamctl.log.row_problems import Flags, RecordProblem
from pamctl.plant.effects.description import USED_SIGNALS
from pamctl.plant.model import PlantSettings

SHORTEST_S = 2.0
QUICK_SAMPLES = 2000
"""A direct mechanism may be quick: so many samples are enough, in whatever time."""
FEWEST_SAMPLES = 100
SHORTEST_STRETCH = 20
"""A stretch between gaps with fewer samples shows nothing."""
HALF_SPAN = 0.5
"""A signal that moves by this share of its span between two samples is not resolved."""
LEAST_COMMAND_V = 0.1
"""A command that varies by less opens no valve."""
MEAN_S, LATEST_S = 0.5, 0.2
"""Means over this time hide how quickly a regulator answers, up to this late."""
COPY = 0.997
"""Squared correlation with the set point of a regulator: 0.999 or more. A valve's command has up to
0.95; 0.99 where a fifth of its full opening leaks and it is opened little."""
LEAST_BETWEEN = 0.3
"""Share of a command's samples away from its ends: any two levels lie on a straight line."""
STILL_TIMES_NOISE = 10.0
"""A signal that varies by less than this multiple of its noise tells nothing."""


def list_used_channels(record: Record, plant: PlantSettings) -> tuple[str, ...]:
    """Return the measured channels that this plant's model reads."""
    used = USED_SIGNALS[plant.actuator]
    return tuple(channel for channel in record.channels if channel in used)


DRIVERS: Mapping[str, tuple[str, ...]] = {
    "muscle": ("valve_v", "pressure_pa"),
    "cylinder": ("valve_v", "pressure_pa"),
    "chamber": ("valve_v",),
    "direct": ("force_n",),
}
"""One of these drives an actuator's model; an axis with a piston is driven by the pressure too."""


def doubt_drive(record: Record, actuator: str, *, has_piston: bool) -> Iterator[Problem]:
    """Yield that a record does not hold what drives this actuator's model."""
    drivers = (*DRIVERS[actuator], *["pressure_pa"] * (has_piston and actuator == "direct"))
    if set(drivers) & set(record.channels):
        return
    needed = " or ".join(drivers)
    ways = (
        ", such as a drive's current with `unit: N` and its N/A for `gain`; or pressure_pa, with "
        "`effects: {piston: {area_m2: ...}}` in the plant file"
    )
    text = (
        f"the plant file has `actuator: {actuator}`, which {needed} must drive; the record holds "
    )
    fix = f"give {needed}, by a map where no header names it{ways * (needed == 'force_n')}; or "
    text, fix = text + ", ".join(record.channels), fix + _ANOTHER_PLANT
    yield Problem(record.name, "actuator", text, fix=fix)


def doubt_actuator(record: Record, plant: PlantSettings) -> Iterator[Problem]:
    """Yield why a record, with all its channels, is not one of what the plant file describes."""
    yield from doubt_drive(record, plant.actuator, has_piston="piston" in plant.acting)
    span_m = _find_motion_m(record)
    moves = f"position_m moves by {1e3 * span_m:.3g} mm, and the plant file"
    if plant.actuator == "chamber" and span_m:
        text, fix = f"{moves} has `actuator: chamber`, which does not move", _ANOTHER_PLANT
        yield Problem(record.name, "actuator", text, fix=f"{fix}, as a muscle or a cylinder")
    if plant.stroke_m and span_m > BEYOND_STROKE * plant.stroke_m:
        text = f"{moves}'s stroke_m is {1e3 * plant.stroke_m:.3g} mm between two stops"
        fix = "give the column's unit, or the stroke, as it is"
        yield Problem(record.name, "actuator", text, fix=fix)


LEAST_CLIPPED = 0.02
"""Share of a record; a shorter time at an extreme spoils no fit."""
BEYOND_STROKE = 1.05
"""Stops give way, and a position sensor's scale is off, by less."""
_ANOTHER_PLANT = "make the plant file of what was measured (`pamctl plant new`)"


def _find_motion_m(record: Record) -> float:
    """Return how far the position moves; 0 where it is not there, or shows no more than noise."""
    if record.position_m is None or not np.isfinite(record.position_m).all():
        return 0.0
    low, high = find_usual_ends(record.position_m)
    return high - low if high - low > _span_of_noise(record.position_m) else 0.0


def doubt_record(record: Record, plant: PlantSettings) -> Iterator[Problem]:
    """Yield what is doubtful about the times and units of a record."""
    found = [_doubt_length(record, plant), _doubt_rate(record, plant)]
    if "valve_v" in list_used_channels(record, plant):
        found += [_doubt_command_unit(record), _doubt_regulator(record)]
    if record.pressure_pa is not None:
        found.append(_doubt_pressure_unit(record, plant))
    if record.position_m is not None and plant.actuator == "muscle":
        found.append(_doubt_position(record, plant))
    for key, text, fix in chain.from_iterable(found):
        yield Problem(record.name, key, text, fix=fix)


_Doubts = Iterator[tuple[str, str, str]]
"""Rule, what is doubtful, and what to do."""


def _doubt_length(record: Record, plant: PlantSettings) -> _Doubts:
    stretches = [s for s in record.segments if s.stop - s.start >= SHORTEST_STRETCH]
    if sum(s.stop - s.start for s in stretches) < FEWEST_SAMPLES:
        longest = int(np.argmax(record.step_s))
        text = (
            f"{count_of(len(record.segments) - 1, 'gap')}, the longest of "
            f"{record.step_s[longest]:.3g} s after row {longest}, leave no stretch of "
            f"{SHORTEST_STRETCH} samples, or fewer than {FEWEST_SAMPLES} samples in such stretches"
        )
        yield "gap", text, "record without pauses of the logger"
    is_quick = plant.actuator == "direct" and len(record) >= QUICK_SAMPLES
    if record.duration_s < SHORTEST_S and not is_quick:
        text = f"{record.duration_s:.3g} s long, shorter than {SHORTEST_S:g} s"
        yield "short", text, "record a whole excitation"


def _doubt_rate(record: Record, plant: PlantSettings) -> _Doubts:
    """Doubt a rate at which a state of the plant jumps: how it came there was not seen.

    Single outliers do not count. A measured input, such as a force, may jump. Where nothing moves,
    what jumps is noise.
    """
    if _is_at_rest(record, plant):
        return
    states = {"position_m"} if plant.actuator == "direct" else {"position_m", "pressure_pa"}
    inside = record.step_s <= record.longest_step_s
    for channel in record.channels:
        span = float(np.ptp(record[channel]))
        if channel not in states or span == 0.0:
            continue
        smooth = median_filter(record[channel], 3, mode="nearest")
        jumps = np.where(inside, np.abs(np.diff(smooth)), 0.0)
        largest = int(np.argmax(jumps))
        if jumps[largest] > HALF_SPAN * span:
            text = (
                f"{channel} passes {100.0 * jumps[largest] / span:.0f} % of its span between two "
                f"samples (row {largest}), {1e3 * record.step_s[largest]:.3g} ms apart: how it "
                "came there was not seen"
            )
            yield "coarse", text, "sample at least ten times faster"


def _doubt_command_unit(record: Record) -> _Doubts:
    values = record["valve_v"]
    low, high = float(values.min()), float(values.max())
    runs = f"valve_v runs from {low:.3g} to {high:.3g}"
    if is_switched(values):
        middle = 0.5 * (low + high)
        falls = [level for level, there in ((low, values < middle), (high, values > middle))
                 if _falls_while(record, there)]  # fmt: skip
        if falls or high > 5.5:
            shown = "".join(f" the muscle loses its air while it is {x:.3g};" for x in falls)
            text = f"{runs}: a valve that switches;{shown} the model reads 5 V as filling, -5 V as "
            text += "exhausting, 0 V as closed"
            fix = "map each level to what it does on your rig (gain and offset of the valve in the "
            yield "command_unit", text, fix + "import map)"
    elif high > 10.5 or low < -10.5:
        text = f"{runs}: not volts of command (-5 to 5)"
        yield "command_unit", text, "is it in mV or per cent?"
    elif low > -0.2 and high > 5.5:
        text = f"{runs}: the output voltage, not the command? The command is 0 V where the valve "
        text += "closes, and rises as it fills"
        fix = "subtract the driver's offset (5 V where 0 to 10 V drive the valve), and turn the "
        yield "command_unit", text, fix + "sign if more volts exhaust"


def _doubt_regulator(record: Record) -> _Doubts:
    """Doubt a command that the pressure follows on a straight line: a valve's is its rate."""
    command, pressure = record.valve_v, record.pressure_pa
    window, lags = round(MEAN_S / record.period_s), round(LATEST_S / record.period_s)
    if command is None or pressure is None or len(command) < 10 * window or window < 1:
        return
    middle, span = 0.5 * (np.max(command) + np.min(command)), np.ptp(command)
    if not span > 0.0 or np.mean(np.abs(command - middle) < 0.4 * span) < LEAST_BETWEEN:
        return
    kept = slice(window, -window)
    asked, got = (uniform_filter1d(row, window)[kept] for row in (command, pressure))
    if not (asked[: len(asked) - lags].std() and got[lags:].std()):
        return
    alike = max(
        np.corrcoef(asked[: len(asked) - lag], got[lag:])[0, 1] ** 2
        for lag in range(0, lags + 1, max(1, lags // 20))
    )
    if alike >= COPY:
        text = (
            f"pressure_pa follows valve_v like a copy: {100.0 * alike:.2f} % of its variance lies "
            f"on one straight line, in means over {MEAN_S:g} s, where a valve's command is the "
            "rate of the pressure. It looks like the set point of a pressure regulator, of which "
            "pamctl has no model, and like no valve"
        )
        fix = "leave the column out of the map: then only the mechanics is asked"
        yield "regulator", text, fix


def _falls_while(record: Record, there: Flags) -> bool:
    """Tell whether half of the pressure's span, or of the position's, is lost in these samples."""
    column = record.pressure_pa if record.pressure_pa is not None else record.position_m
    if column is None:
        return False
    lost = -np.minimum(np.diff(median_filter(column, 5, mode="nearest")), 0.0)
    inside, outside = lost[there[:-1]], lost[~there[:-1]]
    return float(inside.sum()) > 0.5 * float(np.ptp(column)) and bool(
        inside.mean() > 2.0 * outside.mean()
    )


def _doubt_pressure_unit(record: Record, plant: PlantSettings) -> _Doubts:
    low, high = find_usual_ends(record["pressure_pa"])
    atmosphere, tank = plant.parameters.atmospheric_pressure_pa, plant.parameters.tank_pressure_pa
    falls = f"pressure_pa falls to {low:.4g} Pa"
    if low < -1.1 * atmosphere:
        text = f"{falls}, and no gauge shows less than a vacuum"
        yield "pressure_unit", text, "is its sign turned, or its zero off?"
    elif high < 5e3:
        text = f"pressure_pa runs from {low:.3g} to {high:.3g}: not absolute pascals"
        yield "pressure_unit", text, "is it in kPa or bar?"
    elif low < 0.5 * atmosphere:
        text = f"{falls}, below the atmosphere"
        yield "pressure_unit", text, "is it gauge pressure? It must be absolute"
    elif high > 2.0 * tank and plant.actuator != "direct":
        text = f"pressure_pa rises to {high:.4g} Pa, the tank has {tank:.4g} Pa"
        fix = "wrong unit, or the wrong tank_pressure_pa in the plant file?"
        yield "pressure_unit", text, fix


def _doubt_position(record: Record, plant: PlantSettings) -> _Doubts:
    low, high = float(record["position_m"].min()), float(record["position_m"].max())
    length_m = plant.parameters.rest_length_m
    nearest, farthest = sorted((abs(low), abs(high)))
    runs = f"position_m runs from {low:.3g} to {high:.3g}"
    if 0.5 * length_m < nearest and farthest < 1.05 * length_m:
        text = f"{runs} m: the length of the muscle, which is {length_m:.3g} m at rest "
        text += "(rest_length_m), not how far it has contracted"
        fix = "give the map's position an offset, the length at rest in the column's unit, and a "
        yield "position_unit", text, fix + "gain of -1: contraction = offset - length"
    elif farthest > 0.45 * length_m:
        text = f"{runs}, and the plant file's muscle is {length_m:.3g} m long (rest_length_m)"
        fix = "is the column in mm or counts, or the plant file that of another actuator?"
        yield "position_unit", text, fix
    elif record.pressure_pa is not None and low < -0.02 * length_m:
        fix = "contraction must count positive, from zero at the vented muscle"
        yield "position_sign", f"position_m falls to {low:.3g} m", fix


def doubt_sensors(record: Record, plant: PlantSettings) -> Iterator[Problem]:
    """Yield doubts about clipped channels, and shifted ones."""
    columns = measured_columns({c: record[c] for c in list_used_channels(record, plant)})
    for problem in find_record_problems(record.t_s, columns):
        if problem.kind == "clipped" and problem.share >= LEAST_CLIPPED:
            yield from _doubt_clipped(record, plant, problem)
    yield from check_time_shifts(record, rests_on_stop=plant.stroke_m is not None)


def _doubt_clipped(record: Record, plant: PlantSettings, found: RecordProblem) -> Iterator[Problem]:
    """Yield that a channel stands still at its extreme where its noise, or a push, should show."""
    # A muscle that its pressure pushes cannot rest, unless its load, or a piston, is at a stop.
    muscle = plant.actuator == "muscle" and plant.stroke_m is None and found.column == "position_m"
    values = record[found.column]
    if muscle or estimate_white_noise(values) > max(2.0 * find_sensor_step(values), 1e-12):
        yield Problem(
            record.name,
            "clipped",
            f"{found.column} {found.text}, for {100.0 * found.share:.0f} % of the time",
            fix="widen its range, or drive less far"
            + ("; or give the plant file stroke_m, the way between the stops" * muscle),
        )


def _is_at_rest(record: Record, plant: PlantSettings) -> bool:
    """Tell whether the command holds one value, or else, without it, nothing varies."""
    used = list_used_channels(record, plant)
    asked = ("valve_v",) if "valve_v" in used else used
    return all(_find_span(record, c) < _least_span(record, plant, c) for c in asked)


def _find_span(record: Record, channel: str) -> float:
    low, high = find_usual_ends(record[channel])
    return high - low


def doubt_excitation(records: Sequence[Record], plant: PlantSettings) -> Iterator[Problem]:
    """Find a channel that hardly varies in any record: it tells nothing."""
    for channel in CHANNELS:
        # A regulator may hold the pressure on a piston: then the motion is the excitation.
        if plant.actuator == "direct" and channel == "pressure_pa":
            continue
        asked = [r for r in records if channel in list_used_channels(r, plant)]
        spans = [(_find_span(r, channel), r) for r in asked]
        if spans and all(span < _least_span(r, plant, channel) for span, r in spans):
            yield Problem(
                "",
                "still",
                f"{channel} varies by only {max(span for span, _ in spans):.3g} "
                f"{CHANNELS[channel]} over all records: it is not excited",
                fix="record a motion that drives it, or give the unit of the column",
            )


def _least_span(record: Record, plant: PlantSettings, channel: str) -> float:
    """Return the variation that a channel needs: more than its noise; of a muscle, a part of it."""
    if channel == "valve_v":  # no sensor: the step of a square command is no resolution
        return LEAST_COMMAND_V
    least = _span_of_noise(record[channel])
    if plant.actuator == "direct":
        return least
    shares = {
        "pressure_pa": 0.02 * plant.parameters.tank_pressure_pa,
        "position_m": 2e-3 * plant.parameters.rest_length_m,
    }
    return max(least, shares.get(channel, 0.0))


def _span_of_noise(values: Array) -> float:
    """Return the variation that noise and rounding may make."""
    noise = max(estimate_white_noise(values), find_sensor_step(values))
    return max(STILL_TIMES_NOISE * noise, 1e-12)
