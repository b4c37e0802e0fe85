"""Refuse data that would mislead the diagnosis; say why, and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pamctl.diagnose.measured.column_shift import check_time_shifts
from pamctl.diagnose.measured.record import CHANNELS, Array, Record
from pamctl.diagnose.measured.sensor_noise import Noise
from pamctl.exit_codes import ExitCode
from pamctl.plant.model import PlantSettings

LONGEST_GAP_S = 0.05
"""A few missed ticks only make a time step longer; a longer gap hides commands."""
SHORTEST_S = 2.0


class BadData(Exception):
    """The measurement cannot be diagnosed; the message says why and what to do."""

    exit_code = ExitCode.BAD_DATA


def check_measured_runs(records: Sequence[Record], plant: PlantSettings) -> None:
    """Raise `BadData` with every reason found, a line each."""
    reasons = [reason for record in records for reason in _check_record(record, plant)]
    reasons += _check_channels(records)
    reasons += [] if reasons else _check_excitation(records, plant)
    if reasons:
        raise BadData("\n".join(dict.fromkeys(reasons)))


def check_sensors(records: Sequence[Record], noises: dict[str, Noise]) -> None:
    """Raise `BadData` for clipped channels, which their noise reveals, and for shifted ones."""
    reasons = [
        reason
        for record in records
        for channel in record.channels
        for reason in _check_clipping(record, channel, noises.get(channel))
    ]
    reasons += [reason for record in records for reason in check_time_shifts(record)]
    if reasons:
        raise BadData("\n".join(dict.fromkeys(reasons)))


def _check_record(record: Record, plant: PlantSettings) -> Iterator[str]:
    if len(record) < 100 or record.duration_s < SHORTEST_S:
        yield f"{record.name}: shorter than {SHORTEST_S:g} s; record a whole excitation"
        return
    for channel in record.channels:
        wrong = ~np.isfinite(record[channel])
        if wrong.any():
            yield (
                f"{record.name}: {channel} is NaN or infinite in {int(wrong.sum())} rows, "
                f"the first is row {int(np.argmax(wrong))}; remove or repair them"
            )
            return
    if not np.isfinite(record.t_s).all() or np.any(record.step_s <= 0.0):
        row = int(np.argmax(~(record.step_s > 0.0))) + 1
        yield f"{record.name}: t_s does not increase at row {row}; sort or repair the time column"
        return
    yield from _check_gaps(record)
    yield from _check_units(record, plant)


def _check_gaps(record: Record) -> Iterator[str]:
    longest = int(np.argmax(record.step_s))
    gap_s = float(record.step_s[longest])
    if gap_s > max(LONGEST_GAP_S, 5.0 * record.period_s):
        yield (
            f"{record.name}: a gap of {gap_s:.3g} s after row {longest}: what the valve did there "
            "is unknown; split the log at the gap"
        )
    if record.period_s > 0.012:
        yield (
            f"{record.name}: sampled every {record.period_s * 1e3:.3g} ms; "
            "the muscle fills within 50 ms: record at 1 kHz"
        )


def _check_units(record: Record, plant: PlantSettings) -> Iterator[str]:
    yield from _check_command_unit(record)
    yield from _check_pressure_unit(record, plant)
    yield from _check_position_unit(record, plant)


def _check_command_unit(record: Record) -> Iterator[str]:
    if record.valve_v is None:
        return
    low, high = float(record.valve_v.min()), float(record.valve_v.max())
    runs = f"{record.name}: valve_v runs from {low:.3g} to {high:.3g}"
    if high > 10.5 or low < -10.5:
        yield f"{runs}: not volts of command (-5 to 5); is it in mV or per cent?"
    elif low > -0.2 and high > 5.5:
        yield (f"{runs}: the output voltage, not the command; subtract the driver's offset (5 V)")


def _check_pressure_unit(record: Record, plant: PlantSettings) -> Iterator[str]:
    if record.pressure_pa is None:
        return
    low, high = _usual_ends(record.pressure_pa)
    atmosphere, tank = plant.parameters.atmospheric_pressure_pa, plant.parameters.tank_pressure_pa
    if high < 5e3:
        yield (
            f"{record.name}: pressure_pa runs from {low:.3g} to {high:.3g}: not absolute "
            "pascals; is it in kPa or bar?"
        )
    elif low < 0.5 * atmosphere:
        yield (
            f"{record.name}: pressure_pa falls to {low:.4g} Pa, below the atmosphere: "
            "is it gauge pressure? It must be absolute"
        )
    elif high > 2.0 * tank:
        yield (
            f"{record.name}: pressure_pa rises to {high:.4g} Pa, the tank has {tank:.4g} Pa: "
            "wrong unit, or the wrong tank_pressure_pa in the plant file"
        )


def _check_position_unit(record: Record, plant: PlantSettings) -> Iterator[str]:
    if record.position_m is None:
        return
    low, high = float(record.position_m.min()), float(record.position_m.max())
    length_m = plant.parameters.rest_length_m
    if max(abs(low), abs(high)) > 0.45 * length_m:
        yield (
            f"{record.name}: position_m runs from {low:.3g} to {high:.3g}, the muscle is "
            f"{length_m:.3g} m long: is it in mm or counts?"
        )
    elif record.pressure_pa is not None and low < -0.02 * length_m:
        yield (
            f"{record.name}: position_m falls to {low:.3g} m: contraction must count "
            "positive, from zero at the vented muscle"
        )


def _usual_ends(values: Array) -> tuple[float, float]:
    return float(np.quantile(values, 0.001)), float(np.quantile(values, 0.999))


def _check_clipping(record: Record, channel: str, noise: Noise | None) -> Iterator[str]:
    """Find a channel that stands still at its extreme value, where its noise should show."""
    if noise is None:  # the command has no sensor
        return
    values = record[channel]
    for end, extreme in (("highest", values.max()), ("lowest", values.min())):
        at_end = values == extreme
        share = float(at_end.mean())
        run = _longest_run(at_end)
        if share < 0.02 or run < 20:
            continue
        noisy = noise.deviation > noise.resolution and noise.deviation > 0.0
        pushed = channel == "position_m" and _is_still_pushed(record, at_end)
        if noisy or pushed:
            yield (
                f"{record.name}: {channel} stays at its {end} value {extreme:.6g} for "
                f"{100.0 * share:.0f} % of the time: the sensor is clipped; widen its range, "
                "or drive less far"
            )


def _is_still_pushed(record: Record, at_end: NDArrayBool) -> bool:
    """Tell whether the pressure changes by more than friction holds while the position rests."""
    if record.pressure_pa is None:
        return False
    span = float(np.ptp(record.pressure_pa))
    inside = record.pressure_pa[at_end]
    return bool(np.quantile(inside, 0.98) - np.quantile(inside, 0.02) > 0.35 * span)


def _longest_run(flags: NDArrayBool) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0]))))
    return int((edges[1::2] - edges[::2]).max()) if len(edges) else 0


def _check_excitation(records: Sequence[Record], plant: PlantSettings) -> Iterator[str]:
    """Find a channel that hardly moves in any record: it tells nothing."""
    least = {
        "valve_v": 0.1,
        "pressure_pa": 0.02 * plant.parameters.tank_pressure_pa,
        "position_m": 2e-3 * plant.parameters.rest_length_m,
        "force_n": 2.0,
    }
    for channel in CHANNELS:
        spans = [
            np.subtract(*_usual_ends(r[channel])[::-1]) for r in records if channel in r.channels
        ]
        if spans and max(spans) < least[channel]:
            yield (
                f"{channel} varies by only {max(spans):.3g} over all records: it is not excited; "
                "record `pamctl run --experiment diagnosis`"
            )


def _check_channels(records: Sequence[Record]) -> Iterator[str]:
    channels = {record.channels for record in records}
    if len(channels) > 1:
        listed = "; ".join(sorted({f"{r.name} has {', '.join(r.channels)}" for r in records}))
        yield f"the records do not hold the same channels: {listed}"


NDArrayBool = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
