"""What sensors and software added to a record: taken off, or left out; and what is known of it.

Stamps that scatter give way to the regular grid. Spikes, dropouts and missing cells are bridged and
do not count.
Mains hum is taken off. The zeros that homing gave the pressure sensor are aligned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening

from pamctl.base.texts import count_of
from pamctl.diagnose.record import CHANNELS, REST_V, SENSORS, Array, FaultKind, Record, SensorFault
from pamctl.log.record_problems import (
    LONGEST_DROPOUT,
    MOST_SPIKES,
    count_jumps,
    find_excursions,
    round_to_steps,
)

Rows = NDArray[np.bool_]


def mend_records(records: Sequence[Record]) -> tuple[list[Record], list[SensorFault]]:
    """Return the records of a rig without what can be mended, and what was found.

    A record that cannot be used at all is returned as it is: the checks of the data refuse it.
    """
    filled = [fill_missing(record) for record in records]
    mended = [whole for whole, _ in filled]
    faults = [fault for _, missing in filled for fault in missing]
    usable = [k for k, record in enumerate(mended) if _is_usable(record)]
    grids = find_regular_times([mended[k] for k in usable])
    for k, times in zip(usable, grids, strict=True):
        record = mended[k]
        if times is not None:
            scatter_s = float(np.std(record.t_s - times))
            says = f"{record.name}: the time stamps scatter by {scatter_s * 1e3:.3g} ms while the "
            says += "samples are regular; the regular grid is used"
            faults.append(SensorFault("t_s", "jitter", says))
            record = replace(record, t_s=times)
        mended[k], found = _mend_channels(record)
        faults += found
    return mended, faults


def fill_missing(record: Record) -> tuple[Record, list[SensorFault]]:
    """Return a record whose missing cells are bridged and do not count, and what was missing.

    Where the command or the force is missing for long nothing is known of what acted: these rows
    go, and time has a gap there. A record that lacks much of a channel is returned as it is.
    """
    missing = {c: ~np.isfinite(record[c]) for c in record.channels}
    missing = {c: gone for c, gone in missing.items() if gone.any()}
    if not missing or any(gone.mean() > GONE for gone in missing.values()):
        return record, []
    faults, filled, kept = [], dict[str, Any](), np.ones(len(record), np.bool_)
    for channel, gone in missing.items():
        says = f"{record.name}: {channel} is missing in {count_of(int(gone.sum()), 'sample')}, "
        says += f"the first at {record.t_s[int(np.argmax(gone))]:.6g} s; they do not count"
        faults.append(SensorFault(channel, "dropouts", says))
        filled[channel] = bridge(record[channel], gone)
        if channel in ("valve_v", "force_n"):
            kept &= ~binary_opening(gone, np.ones(LONGEST_DROPOUT + 1))
        if channel == "valve_v":  # a card holds it
            last = np.maximum.accumulate(np.where(gone, 0, np.arange(len(gone))))
            filled[channel] = np.where(gone[last], filled[channel], record[channel][last])
    counts = ~np.any([*missing.values()], axis=0)
    return replace(record, **filled, counts=counts).keep_rows(kept), faults


def _is_usable(record: Record) -> bool:
    usable = len(record) >= 100 and bool(np.all(record.step_s > 0.0))
    return usable and all(np.isfinite(record[c]).all() for c in record.channels)


def _mend_channels(record: Record) -> tuple[Record, list[SensorFault]]:
    """Bridge outliers and dropouts, and take off hum."""
    faults: list[SensorFault] = []
    counts = np.ones(len(record), np.bool_) if record.counts is None else record.counts.copy()
    mended: dict[str, Any] = {}
    for channel in (c for c in record.channels if c in SENSORS):
        spikes, dropouts = find_outliers(record, channel)
        counts &= ~(spikes | dropouts)
        kinds: tuple[tuple[FaultKind, Rows], ...] = (("outliers", spikes), ("dropouts", dropouts))
        for kind, lost in kinds:
            if lost.any():
                says = f"{record.name}: {channel} has {count_of(int(lost.sum()), kind[:-1])}, "
                says += f"the first in row {int(np.argmax(lost))}; they do not count"
                faults.append(SensorFault(channel, kind, says))
        values = bridge(record[channel], spikes | dropouts)
        if is_filtered(record, channel):
            says = f"{record.name}: {channel} was filtered; use the data as they were measured"
            faults.append(SensorFault(channel, "filtered", says))
        for part in _cut_even_stretches(record):
            command = None if record.valve_v is None else record.valve_v[part]
            values[part], hums = remove_hum(values[part], record.period_s, command)
            for hum in hums:
                says = f"{record.name}: {channel} has {hum.frequency_hz:.0f} Hz of hum, amplitude "
                says += f"{hum.amplitude:.3g} {CHANNELS[channel]}; it is taken off"
                faults.append(SensorFault(channel, "hum", says))
        mended[channel] = values
    steps = {f.channel: record.find_step(f.channel) for f in faults if f.kind == "hum"}
    return replace(record, **mended, counts=None if counts.all() else counts, steps=steps), faults


# --- time stamps ---------------------------------------------------------------------------------

LEAST_SCATTER = 0.02
"""Scatter of the stamps, in periods, below which it does not matter."""
MISSED, LONGEST_STEP = 1.6, 2.5
"""A step of more periods misses a sample; a longer one is a gap, and the grid begins anew."""
FARTHEST = 4.0
"""Periods that a stamp may be from the grid; clocks that run apart have no common grid."""
SAMPLES, ORDER = 7, 3
"""Samples of a stretch, and order of the polynomial that a smooth signal follows over it."""
BETTER, SURE = 1.3, 4.0
"""What the stamps leave over what the grid leaves, in squares; and by how many of its own standard
errors the difference must be away from zero."""


def find_regular_times(records: Sequence[Record]) -> list[Array | None]:
    """Return for each record the times of a regular grid, or None where its stamps are to be used.

    A card samples by its own clock, and a program reads the time when it fetches the sample. A
    signal that moves then looks noisy on its stamps and smooth on a regular grid. One program
    stamped all records: a grid is also used where a slow or noisy signal does not tell.
    """
    grids = [_fit_grid(record) for record in records]
    verdicts = [
        {0}
        if grid_s is None
        else {_compare(r[c], r.t_s, grid_s) for c in r.channels if c != "valve_v"}
        for r, grid_s in zip(records, grids, strict=True)
    ]
    is_sure = any(1 in v and -1 not in v for v in verdicts)
    return [
        grid_s if is_sure and -1 not in v else None
        for grid_s, v in zip(grids, verdicts, strict=True)
    ]


def _cut_even_stretches(record: Record) -> list[slice]:
    """Return the stretches without a missed sample."""
    cuts = np.flatnonzero(record.step_s > MISSED * record.period_s) + 1
    return [slice(a, b) for a, b in pairwise([0, *cuts.tolist(), len(record)])]


def _fit_grid(record: Record) -> Array | None:
    """Return the grid that a record's stamps scatter about; None where they do not."""
    period_s = record.period_s
    cuts = np.flatnonzero(record.step_s > LONGEST_STEP * period_s) + 1
    parts = []
    for part in np.split(record.t_s, cuts):
        index = np.arange(len(part), dtype=np.float64)
        if len(part) < 8 * SAMPLES:
            parts.append(part)
            continue
        line = np.polynomial.Polynomial.fit(index, part, 1)(index)
        if float(np.abs(part - line).max()) > FARTHEST * period_s:
            return None
        parts.append(line)
    grid_s = np.concatenate(parts)
    scatters = float(np.std(record.t_s - grid_s)) >= LEAST_SCATTER * period_s
    return grid_s if scatters and np.all(np.diff(grid_s) > 0.0) else None


def _compare(values: Array, t_s: Array, grid_s: Array) -> int:
    """Return 1 where the grid explains a channel better, -1 where the stamps do, otherwise 0."""
    by_stamps, by_grid = _leave(values, t_s), _leave(values, grid_s)
    difference = by_stamps - by_grid
    error = float(difference.std()) / np.sqrt(max(len(difference), 1))
    if abs(float(difference.mean())) < SURE * error:
        return 0
    stamps, grid = float(by_stamps.sum()), float(by_grid.sum())
    return int(stamps > BETTER * grid) - int(grid > BETTER * stamps)


def _leave(values: Array, t_s: Array) -> Array:
    """Return the squares that a polynomial leaves of each stretch, shape (stretches,)."""
    count = len(values) // SAMPLES
    times, parts = (a[: count * SAMPLES].reshape(count, SAMPLES) for a in (t_s, values))
    scaled = (times - times.mean(axis=1, keepdims=True)) / np.ptp(times, axis=1, keepdims=True)
    basis = np.linalg.qr(np.stack([scaled**n for n in range(ORDER + 1)], axis=2))[0]
    left = parts - np.einsum("kso,ko->ks", basis, np.einsum("kso,ks->ko", basis, parts))
    return np.asarray(np.sum(left**2, axis=1))


# --- spikes and dropouts -------------------------------------------------------------------------

GONE = 0.1
"""Share of a channel's cells that may be missing."""


def find_outliers(record: Record, channel: str) -> tuple[Rows, Rows]:
    """Return the spikes and the dropouts of a channel as masks of its samples, shape (n,).

    A reading of zero, or one that is held, is a dropout.
    """
    values = record[channel]
    jumps = count_jumps(np.zeros(len(values)) if record.valve_v is None else record.valve_v)
    spikes, dropouts = np.zeros(len(values), np.bool_), np.zeros(len(values), np.bool_)
    for start, stop in find_excursions(values, jumps):
        same = stop - start > 1 and np.ptp(values[start:stop]) == 0.0
        (dropouts if same or values[start] == 0.0 else spikes)[start:stop] = True
    same_value = spikes & np.isin(values, values[dropouts])
    spikes, dropouts = spikes & ~same_value, dropouts | same_value
    for found in (spikes, dropouts):
        if found.mean() > MOST_SPIKES:
            found[:] = False
    return spikes, dropouts


def bridge(values: Array, lost: Rows) -> Array:
    """Return the values with straight lines, in the converter's steps, across the lost samples."""
    mended = values.copy()
    if lost.any() and not lost.all():
        index, kept = np.arange(len(values)), values[~lost]
        mended[lost] = round_to_steps(np.interp(index[lost], index[~lost], kept), kept)
    return mended


# --- mains hum -----------------------------------------------------------------------------------

MAINS_HZ = (50.0, 60.0)
WINDOW_S, FEWEST_WINDOWS = 1.0, 4
"""Its amplitude and phase are measured in windows of this length, half over the next."""
BESIDE_HZ = 5.0
"""So far beside the mains a line is compared with what is there without it."""
LINE = 3.0
"""A line stands out of the amplitudes beside it by this factor."""
STEADY = 0.25
"""Scatter of its phasor over its size: a motion has no such steady line, and a chirp passes by."""
ELSEWHERE = 0.35
"""By this share of its size it may be larger or smaller in any window quiet enough to show it."""
LARGEST = 0.05
"""Share of the channel's span that hum may have; more would be an excitation."""
COMMANDED = 1e-2
"""Share of the command's span that a sinusoid in it must have; a step has less at such rates."""


class Hum(NamedTuple):
    """A sinusoid found in a channel."""

    frequency_hz: float
    """Of the mains."""
    amplitude: float
    """In the channel's unit."""


def remove_hum(values: Array, period_s: float, command: Array | None) -> tuple[Array, list[Hum]]:
    """Return evenly sampled values without mains hum, and the hum that was there.

    It belongs to the sensor's cable and not to the rig. A line that the command has too is the
    rig's.
    """
    found: list[Hum] = []
    length = round(WINDOW_S / period_s)
    centres = np.arange(length // 2, len(values) - length // 2, max(length // 2, 1))
    too_short = len(centres) < 2 * FEWEST_WINDOWS or period_s * MAINS_HZ[-1] > 0.4
    if too_short or np.ptp(values) == 0.0:
        return values, found
    parts = [slice(c - length // 2, c - length // 2 + length) for c in centres]
    windows = _flatten_parts(values, parts)
    for mains_hz in MAINS_HZ:
        line = _measure_phasors(windows, parts, period_s * mains_hz)
        beside = [
            np.abs(_measure_phasors(windows, parts, period_s * (mains_hz + side)))
            for side in (-BESIDE_HZ, BESIDE_HZ)
        ]
        # Mains are off by some tenths of a hertz: the phasor turns from window to window.
        turn = float(np.angle(np.sum(line[1:] * np.conj(line[:-1]))))
        still = line * np.exp(-1j * turn * np.arange(len(line)))
        quiet = np.mean(beside, axis=0)
        if not quiet.any():
            continue
        weights = (float(quiet.max()) / np.maximum(quiet, 1e-3 * float(quiet.max()))) ** 2
        if weights.sum() ** 2 < FEWEST_WINDOWS * float(np.sum(weights**2)):
            continue  # one quiet window agrees with itself
        mean = complex(np.sum(weights * still) / weights.sum())
        size = abs(mean)
        scatter = float(np.sqrt(np.sum(weights * np.abs(still - mean) ** 2) / weights.sum()))
        loud = size > LINE * float(np.sqrt(np.sum(weights * quiet**2) / weights.sum()))
        if not loud or scatter > STEADY * size or size > LARGEST * float(np.ptp(values)):
            continue
        off = np.abs(np.abs(line) - size)
        if np.any(off > np.where(quiet < 0.5 * size, np.maximum(ELSEWHERE * size, 2 * quiet), inf)):
            continue
        if command is not None and np.ptp(command) > 0.0:
            commanded = _flatten_parts(command, parts)
            asked = np.abs(_measure_phasors(commanded, parts, period_s * mains_hz))
            if float(np.median(asked)) > COMMANDED * float(np.ptp(command)):
                continue
        index = np.arange(len(values), dtype=np.float64)
        phase = np.angle(mean) + turn * (index - centres[0]) / (centres[1] - centres[0])
        values = values - size * np.cos(2.0 * np.pi * period_s * mains_hz * index + phase)
        windows = _flatten_parts(values, parts)
        found.append(Hum(mains_hz, size))
    return values, found


def _measure_phasors(windows: Sequence[Array], parts: Sequence[slice], share: float) -> Any:
    """Return the phasor at a frequency, in cycles a sample, in each window; complex."""
    taper = np.hanning(len(windows[0]))
    wave = np.exp(-2j * np.pi * share * np.arange(parts[-1].stop))
    return np.array(
        [2.0 * np.sum(taper * v * wave[part]) / taper.sum()
         for v, part in zip(windows, parts, strict=True)]
    )  # fmt: skip


def _flatten_parts(values: Array, parts: Sequence[slice]) -> list[Array]:
    """Return each window without its slow motion, which would leak into a line."""
    return [_flatten_part(values[part]) for part in parts]


def _flatten_part(part: Array) -> Array:
    at = np.linspace(-1.0, 1.0, len(part))
    return part - np.polynomial.chebyshev.Chebyshev.fit(at, part, 5)(at)


# --- the pressure sensor's zero ------------------------------------------------------------------

HOMED_PA = 250.0
"""Homing leaves the zero within this; records that differ by more differ for another reason."""
PIECE_S, FEWEST_PIECES = 0.05, 4
"""Length of the pieces of a rest that are compared at the same time after the start."""
FEWEST_SAMPLES = 100
SURE_DRIFT = 3.0
"""A rest whose difference from the others drifts by this many sigma is no rest."""


def align_resting_pressure(records: Sequence[Record]) -> list[Record]:
    """Return the records with their pressure sensors' zeros aligned at rest; others as they are.

    Homing takes the zero from noisy readings, and from air that has nearly left: records of one rig
    differ by some tens of pascals. What the records share at the same time after the start, such as
    a leak that fills the muscle, is not changed, and the offset that they share stays: it may be
    physical. Only rests under the same command are compared. A difference counts by how much it
    exceeds its own uncertainty; one beyond `HOMED_PA`, or one that drifts, is left.
    """
    aligned, groups = [*records], dict[int, list[tuple[int, Array]]]()
    for k, record in enumerate(records):
        pieces = _average_rest(record)
        if len(pieces) >= FEWEST_PIECES:
            groups.setdefault(round(record["valve_v"][0] / REST_V), []).append((k, pieces))
    for group in groups.values():
        length = min(len(pieces) for _, pieces in group)
        table = np.array([pieces[:length] for _, pieces in group])
        off = table - table.mean(axis=0)
        zeros = off.mean(axis=1) - np.median(off.mean(axis=1))
        for (k, _), zero_pa, row in zip(group, zeros, off, strict=True):
            # Neighbours show the noise alone, also where the pressure drifts.
            uncertain_pa = float(np.sqrt(0.5 * np.mean(np.diff(row) ** 2) / length))
            early, late = np.array_split(row, 2)
            drifts = abs(late.mean() - early.mean()) > SURE_DRIFT * 2.0 * uncertain_pa + 1e-9
            if zero_pa == 0.0 or drifts or abs(zero_pa) > HOMED_PA:
                continue
            excess_pa = zero_pa * max(1.0 - (uncertain_pa / zero_pa) ** 2, 0.0)
            if excess_pa:
                pressure_pa = records[k]["pressure_pa"] - excess_pa
                steps = {**records[k].steps, "pressure_pa": records[k].find_step("pressure_pa")}
                aligned[k] = replace(records[k], pressure_pa=pressure_pa, steps=steps)
    return aligned


def _find_rest(record: Record) -> int:
    """Return how many samples there are before the command first changes; 0 for no rest."""
    if record.valve_v is None or record.valve_v[0] > REST_V:
        return 0
    moved = np.abs(record.valve_v - record.valve_v[0]) > REST_V
    return int(np.argmax(moved)) if moved.any() else len(record)


def _average_rest(record: Record) -> Array:
    """Return the mean pressure of each piece of a rest; empty where there is none."""
    rest = _find_rest(record)
    if record.pressure_pa is None or rest < FEWEST_SAMPLES:
        return np.zeros(0)
    piece = ((record.t_s[:rest] - record.t_s[0]) / PIECE_S + 1e-6).astype(int)
    counts = np.bincount(piece)
    means = np.bincount(piece, weights=record.pressure_pa[:rest]) / np.maximum(counts, 1)
    whole = counts > 0.5 * counts[0]  # the last piece may be a stub
    return np.asarray(means[: int(np.argmin(whole))] if not whole.all() else means)


# --- filters -------------------------------------------------------------------------------------

FEWEST_AT_REST = 256
"""Samples of a rest that show whether its noise was filtered."""
APART, SMOOTHER = 8, 8.0
"""Third differences over so many samples are larger by this factor than those of neighbours where
a filter took the fast noise away: of white noise they are equal, of a random walk 2.8 times."""


def is_filtered(record: Record, channel: str) -> bool:
    """Tell whether somebody smoothed a channel, by the noise of its rest."""
    rest = record[channel][: _find_rest(record)]
    if len(rest) < FEWEST_AT_REST:
        return False
    near, far = (
        float(
            np.std(rest[3 * n :] - 3.0 * rest[2 * n : -n] + 3.0 * rest[n : -2 * n] - rest[: -3 * n])
        )
        for n in (1, APART)
    )
    return far > SMOOTHER * max(near, record.find_step(channel))
