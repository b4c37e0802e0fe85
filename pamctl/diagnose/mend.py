"""Mend a record before it is used: what sensors and software added is taken off or left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d
from scipy.signal import butter, sosfiltfilt, sosfreqz

from pamctl.diagnose.record import CHANNELS, REST_V, Array, Record
from pamctl.log.record_problems import find_sensor_step

FaultKind = Literal["jitter", "outliers", "dropouts", "hum", "filtered", "unused"]


class SensorFault(NamedTuple):
    """What is wrong with a channel beside its noise."""

    channel: str
    """The channel; `t_s` for the time stamps."""
    kind: FaultKind
    says: str
    """What was found, with the number and its unit, and what was done about it."""


def mend_records(records: Sequence[Record]) -> tuple[list[Record], list[SensorFault]]:
    """Return the records of a rig without what can be mended, and what was found.

    A record that cannot be used at all is returned as it is: the checks of the data refuse it.
    """
    mended, faults = [*records], list[SensorFault]()
    usable = [k for k, record in enumerate(records) if _is_usable(record)]
    grids = find_regular_times([records[k] for k in usable])
    for k, times in zip(usable, grids, strict=True):
        record = records[k]
        if times is not None:
            scatter_s = float(np.std(record.t_s - times))
            says = f"{record.name}: the time stamps scatter by {scatter_s * 1e3:.3g} ms while the "
            says += "samples are regular; the regular grid is used"
            faults.append(SensorFault("t_s", "jitter", says))
            record = replace(record, t_s=times)
        mended[k], found = _mend_channels(record)
        faults += found
    return mended, faults


def _is_usable(record: Record) -> bool:
    usable = len(record) >= 100 and bool(np.all(record.step_s > 0.0))
    return usable and all(np.isfinite(record[c]).all() for c in record.channels)


def _mend_channels(record: Record) -> tuple[Record, list[SensorFault]]:
    """Bridge outliers and dropouts, and take off hum."""
    faults: list[SensorFault] = []
    counts = np.ones(len(record), np.bool_)
    mended: dict[str, Any] = {}
    for channel in (c for c in record.channels if c != "valve_v"):
        spikes, dropouts = find_outliers(record, channel)
        lost = spikes | dropouts
        counts &= ~lost
        faults += _describe_lost(record.name, channel, "outliers", spikes)
        faults += _describe_lost(record.name, channel, "dropouts", dropouts)
        values, hums = _remove_hums(record, bridge(record[channel], lost))
        faults += [
            SensorFault(
                channel,
                "hum",
                f"{record.name}: {channel} has {hum.frequency_hz:.0f} Hz of hum, amplitude "
                f"{hum.amplitude:.3g} {CHANNELS[channel]}; it is taken off",
            )
            for hum in hums
        ]
        mended[channel] = values
    return replace(record, **mended, counts=None if counts.all() else counts), faults


def _describe_lost(
    name: str, channel: str, kind: FaultKind, lost: NDArray[np.bool_]
) -> list[SensorFault]:
    if not lost.any():
        return []
    says = f"{name}: {channel} has {int(lost.sum())} samples that are {kind}, the first in row "
    return [SensorFault(channel, kind, f"{says}{int(np.argmax(lost))}; they do not count")]


def _remove_hums(record: Record, values: Array) -> tuple[Array, list[Hum]]:
    """Remove hum from each stretch without a missed sample."""
    values, found = values.copy(), []
    for part in cut_even_stretches(record):
        command = None if record.valve_v is None else record.valve_v[part]
        values[part], hums = remove_hum(values[part], record.period_s, command)
        found += hums
    return values, found


LEAST_SCATTER = 0.02
"""Scatter of the stamps, in periods, below which it does not matter."""
LONGEST_STEP = 2.5
"""A step of more periods is a gap; the grid begins anew after it."""
FARTHEST = 4.0
"""Periods that a stamp may be from the grid; clocks that run apart have no common grid."""
MISSED = 1.6
"""A step of more periods misses a sample."""
SAMPLES, ORDER = 7, 3
"""Samples of a stretch, and order of the polynomial that a smooth signal follows over it."""
BETTER = 1.3
"""What the stamps leave over what the grid leaves, in squares."""
SURE = 4.0
"""By how many of its own standard errors the difference must be away from zero."""


def find_regular_times(records: Sequence[Record]) -> list[Array | None]:
    """Return for each record the times of a regular grid, or None where its stamps are to be used.

    The grid is used where it explains the signals better. One program stamped all records: if it
    does so in one, it is also used where a slow or noisy signal does not tell.
    """
    grids = [_find_grid(record) for record in records]
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


def _find_grid(record: Record) -> Array | None:
    """Return the grid that a record's stamps scatter about; None where they do not."""
    grid_s = _fit_grid(record.t_s, record.period_s)
    if grid_s is None or float(np.std(record.t_s - grid_s)) < LEAST_SCATTER * record.period_s:
        return None
    return grid_s


def cut_even_stretches(record: Record) -> list[slice]:
    """Return the stretches without a missed sample."""
    cuts = np.flatnonzero(record.step_s > MISSED * record.period_s) + 1
    edges = [0, *cuts.tolist(), len(record)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _fit_grid(t_s: Array, period_s: float) -> Array | None:
    cuts = np.flatnonzero(np.diff(t_s) > LONGEST_STEP * period_s) + 1
    parts = []
    for part in np.split(t_s, cuts):
        index = np.arange(len(part), dtype=np.float64)
        if len(part) < 8 * SAMPLES:
            parts.append(part)
            continue
        line = np.polynomial.Polynomial.fit(index, part, 1)(index)
        if float(np.abs(part - line).max()) > FARTHEST * period_s:
            return None
        parts.append(line)
    grid_s = np.concatenate(parts)
    return grid_s if np.all(np.diff(grid_s) > 0.0) else None


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
    shape = (count, SAMPLES)
    times, parts = (a[: count * SAMPLES].reshape(shape) for a in (t_s, values))
    middle = times.mean(axis=1, keepdims=True)
    scaled = (times - middle) / np.ptp(times, axis=1, keepdims=True)
    basis = np.linalg.qr(np.stack([scaled**n for n in range(ORDER + 1)], axis=2))[0]
    inside = np.einsum("kso,ks->ko", basis, parts)
    left = parts - np.einsum("kso,ko->ks", basis, inside)
    squares: Array = np.sum(left**2, axis=1)
    return squares


Rows = NDArray[np.bool_]
Counts = NDArray[np.intp]

LONGEST_DROPOUT = 20
"""Samples that a dropout may last; a longer one is not mended here."""
MOST = 0.02
"""Share of the samples that may be outliers. More are not single, but the signal."""
JUMP = 9.0
"""An outlier is this many local deviations away."""
BACK = 0.25
"""How far from its level before an outlier the signal may be afterwards, as a share of the jump."""
JUMP_SHARE = 0.2
"""Share of its span by which a command jumps; a smooth one does not change so much in a sample."""
ANSWER = 4
"""Samples after a jump of the command in which a rig may begin to answer it by a jump."""
NO_ANSWER = 0.3
"""Share of its span that no rig goes and comes back at once if the command jumped only once."""
AROUND = 8
"""Samples before and after an outlier that show how busy the signal is."""
MOST_EQUAL = 0.3
"""Where more neighbours than this share are equal, the converter is too coarse to show a hold."""
CHANCE = 1e-3
"""Chance in a whole record that noise holds a value for as long as a dropout."""


def find_outliers(record: Record, channel: str) -> tuple[Rows, Rows]:
    """Return the spikes and the dropouts of a channel as masks of its samples, shape (n,)."""
    values = record[channel]
    spikes, dropouts = np.zeros(len(values), np.bool_), np.zeros(len(values), np.bool_)
    for start, stop in _find_excursions(values, _count_commands(record)):
        same = stop - start > 1 and np.ptp(values[start:stop]) == 0.0
        at_end = values[start] == 0.0
        (dropouts if same or at_end else spikes)[start:stop] = True
    same_value = spikes & np.isin(values, values[dropouts])
    spikes, dropouts = spikes & ~same_value, dropouts | same_value
    for start, stop in _find_held(values):
        dropouts[start:stop] = True
    for found in (spikes, dropouts):
        if found.mean() > MOST:
            found[:] = False
    return spikes, dropouts


def bridge(values: Array, lost: Rows) -> Array:
    """Return the values with straight lines, in the converter's steps, across the lost samples."""
    if not lost.any() or lost.all():
        return values
    index = np.arange(len(values))
    mended = values.copy()
    kept = values[~lost]
    mended[lost] = np.interp(index[lost], index[~lost], kept)
    step = find_sensor_step(kept)
    if step:
        mended[lost] = kept[0] + np.round((mended[lost] - kept[0]) / step) * step
    return mended


def _count_commands(record: Record) -> Counts:
    """Count the jumps of the command up to each sample, shape (n,)."""
    if record.valve_v is None:
        return np.zeros(len(record), np.intp)
    least = JUMP_SHARE * max(float(np.ptp(record.valve_v)), 1e-9)
    jumps = np.abs(np.diff(record.valve_v, prepend=record.valve_v[0])) >= least
    return np.cumsum(jumps)


def _find_excursions(values: Array, commands: Counts) -> Iterator[tuple[int, int]]:
    """Yield [start, stop) of what jumps away and comes back at once."""
    steps = np.diff(values)
    steps -= median_filter(steps, 2 * AROUND + 1, mode="nearest")  # the motion's own
    sizes = np.abs(steps)
    # The usual step around, without the jump itself: a median hardly sees it.
    usual = np.maximum(
        median_filter(sizes, 2 * AROUND + 1, mode="nearest") / 0.6745,
        max(float(np.median(sizes)) / 0.6745, find_sensor_step(values)),
    )
    jumps = np.flatnonzero(sizes > JUMP * usual)
    span = float(np.ptp(values))
    done = 0
    for jump in jumps:
        start = int(jump) + 1
        if start <= done or start < AROUND:
            continue
        stop = _find_return(values, start, float(steps[jump]), float(usual[jump]))
        if stop is None:
            continue
        # A rig may answer a jump of the command by one. It does not go far and come back by itself.
        answered = int(commands[start] - commands[start - ANSWER])
        pulsed = int(commands[stop] - commands[start - ANSWER]) > 1
        if answered and (pulsed or sizes[jump] < NO_ANSWER * span):
            continue
        done = stop
        yield start, stop


def _find_return(values: Array, start: int, jump: float, usual: float) -> int | None:
    """Return where a signal that jumped at `start` is back; None if it is not."""
    before = values[start - AROUND : start]
    slope = float(np.median(np.diff(before)))
    for stop in range(start + 1, min(start + LONGEST_DROPOUT, len(values) - AROUND) + 1):
        expected = before[-1] + slope * (stop - start + 1)
        after = values[stop : stop + AROUND]
        if abs(values[stop] - expected) > max(BACK * abs(jump), 3.0 * usual):
            continue
        if abs(values[stop] - expected) > 0.5 * abs(jump):
            continue
        if float(np.abs(values[start:stop] - expected).min()) < 0.5 * abs(jump):
            return None
        busy = max(_measure_restlessness(part, slope) for part in (before, after))
        return stop if busy < 0.4 * abs(jump) else None
    return None


def _measure_restlessness(part: Array, slope: float) -> float:
    """Return the largest step of a stretch but for two: another outlier may be close by."""
    return float(np.sort(np.abs(np.diff(part) - slope))[-3])


def _find_held(values: Array) -> Iterator[tuple[int, int]]:
    """Yield [start, stop) of equal samples that are too many for the noise around them."""
    equal = np.diff(values) == 0.0
    share, usual = float(equal.mean()), _measure_noise(values)
    if share > MOST_EQUAL or usual < find_sensor_step(values):
        return
    least = max(3, int(np.log(CHANCE / len(values)) / np.log(max(share, 1e-9))) + 2)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], equal.astype(np.int8), [0]))))
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        around = (values[max(start - 12, 0) : start], values[stop + 1 : stop + 13])
        if least <= stop - start <= LONGEST_DROPOUT and all(
            _measure_noise(p) > 0.3 * usual for p in around
        ):
            yield start + 1, stop + 1


def _measure_noise(part: Array) -> float:
    """Return the usual noise of a stretch; a held value has none, and a single spike adds none."""
    if len(part) < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(part, 3))) / (0.6745 * np.sqrt(20.0)))


MAINS_HZ = (50.0, 60.0)
OFF_HZ = 0.5
"""Mains are at most this far from their frequency."""
LINE = 6.0
"""A line stands out of the density beside it by this factor."""
LEFT = 2.5
"""A density of less, over that beside it, is no line."""
LEAST_TAKEN = 0.9
"""Share of a line that a sinusoid takes off; less is not a steady sinusoid."""
BAND = (0.7, 1.4)
"""The sinusoid is fitted to what lies in this band around it: motion is slower, noise faster."""
LARGEST = 0.05
"""Share of the channel's span that hum may have; more would be an excitation."""
STILL_S, SETTLED_S = 0.3, 0.15
"""A command that stands still for this long in all, after it has settled, must show the hum too."""
THERE = (0.7, 1.4)
"""The hum while the command stands still, over what it is on the whole."""
COMMANDED, NEIGHBOUR = 1e-2, 0.1
"""Share of the command's span that a sinusoid in it must have; a step has less at such rates. It
may be this far from the mains, as a share of their frequency: the answer to it is broader."""
PADDED = 15
"""Samples that are mirrored at each end."""
SHORTEST_HUM_S = 2.0
"""A shorter stretch does not tell a line from its neighbours."""
STEADY_S = 4.0
"""Amplitude and phase may change from one such time to the next, for mains drift a little."""


class Hum(NamedTuple):
    """A sinusoid found in a channel."""

    frequency_hz: float
    """Of the mains; sampling may show it at a lower frequency."""
    amplitude: float
    """In the channel's unit."""


def remove_hum(values: Array, period_s: float, command: Array | None) -> tuple[Array, list[Hum]]:
    """Return evenly sampled values without hum, and the hum that was there."""
    found: list[Hum] = []
    if len(values) * period_s < SHORTEST_HUM_S:
        return values, found
    for mains_hz in MAINS_HZ:
        share = _fold(mains_hz * period_s)
        half_width = OFF_HZ * period_s
        # The slow end holds the motion; close to half the sampling rate there is no neighbour.
        line = _measure_line(values, share, half_width, period_s) if 0.04 < share < 0.48 else 0.0
        if line < LINE:
            continue
        still = _find_still(command, period_s)
        if command is not None and not still.any() and _is_commanded(command, share):
            continue
        sinusoid = _fit_sinusoid(values, share, half_width, period_s)
        amplitude = float(np.sqrt(2.0) * sinusoid.std())
        rest = values - sinusoid
        if still.any() and not _is_there(values, sinusoid, still, share):
            continue
        if amplitude > LARGEST * float(np.ptp(values)):
            continue
        if _measure_line(rest, share, half_width, period_s) < max(LEFT, (1.0 - LEAST_TAKEN) * line):
            values = rest
            found.append(Hum(mains_hz, amplitude))
    return values, found


def _fold(cycles: float) -> float:
    """Return the frequency at which sampling shows it, in cycles per sample."""
    return abs(cycles - round(cycles))


def _is_there(values: Array, sinusoid: Array, still: NDArray[np.bool_], share: float) -> bool:
    """Tell whether the values have the sinusoid, at its full size, while the command is still."""
    part, band = sinusoid[still], _pass_band(values, share)
    fitting = float(band[0][still] @ part) / band[1] / max(float(part @ part), 1e-300)
    size = float(part.std()) / max(float(sinusoid.std()), 1e-300)
    return THERE[0] < fitting < THERE[1] and THERE[0] < size < THERE[1]


def _find_still(command: Array | None, period_s: float) -> NDArray[np.bool_]:
    """Mark where the command has stood still for a while; nowhere if that is too short to show."""
    if command is None:
        return np.zeros(0, np.bool_)
    around = 2 * round(SETTLED_S / period_s) + 1
    change = maximum_filter1d(np.abs(np.diff(command, prepend=command[0])), around)
    still: NDArray[np.bool_] = change == 0.0
    return still if float(still.sum()) * period_s >= STILL_S else np.zeros_like(still)


def _is_commanded(command: Array, share: float) -> bool:
    """Tell whether the command itself has a visible part near a frequency."""
    taper = np.hanning(len(command))
    frequencies = np.fft.rfftfreq(4 * len(command))
    amplitudes = np.abs(np.fft.rfft((command - command.mean()) * taper, 4 * len(command)))
    near = np.abs(frequencies - share) <= NEIGHBOUR * share
    amplitude = 2.0 * float(amplitudes[near].max(initial=0.0)) / float(taper.sum())
    return amplitude > COMMANDED * float(np.ptp(command))


def _measure_line(values: Array, share: float, half_width: float, period_s: float) -> float:
    """Return by what factor the power at a frequency stands out of that beside it."""
    band = _pass_band(values, share)[0]
    quiet = band * _weigh_quiet(band, share)
    length = min(round(STEADY_S / period_s), len(values))
    parts = quiet[: len(quiet) // length * length].reshape(-1, length) * np.hanning(length)
    power = np.sum(np.abs(np.fft.rfft(parts, axis=1)) ** 2, axis=0)
    off = np.abs(np.fft.rfftfreq(length) - share)
    inside = off <= max(half_width, 1.0 / length)
    beside = ~inside & (off > 3.0 / length) & (off < (BAND[1] - 1.0) * share)
    # A motion with a period has lines everywhere: the strongest neighbours count.
    usual = float(np.quantile(power[beside], 0.9)) if beside.sum() > 8 else 0.0
    return float(power[inside].max()) / usual if usual > 0.0 else 0.0


def _pass_band(values: Array, share: float) -> tuple[Array, float]:
    """Return what lies around a frequency, and the filter's gain there."""
    band = [BAND[0] * share, min(BAND[1] * share, 0.49)]
    sections = butter(2, band, "bandpass", fs=1.0, output="sos")
    (passed,) = sosfreqz(sections, [2.0 * np.pi * share])[1]
    filtered = sosfiltfilt(sections, values, padlen=min(PADDED, len(values) - 1))
    return np.asarray(filtered), float(abs(passed) ** 2)


def _weigh_quiet(band: Array, share: float) -> Array:
    """Return weights: what moves the rig is loud for a while, and hum is there all the time."""
    level = uniform_filter1d(band**2, max(round(2.0 / share), 3))
    least = max(float(np.quantile(level, 0.2)), 1e-9 * float(level.max()))
    weights: Array = least / np.maximum(level, least) if least > 0.0 else np.ones(len(band))
    return weights


def _fit_sinusoid(values: Array, share: float, half_width: float, period_s: float) -> Array:
    """Fit a sinusoid whose amplitude and phase change slowly, mostly where the motion is quiet."""
    index = np.arange(len(values), dtype=np.float64)
    band, gain = _pass_band(values, share)
    weights = _weigh_quiet(band, share)
    frequencies = np.fft.rfftfreq(8 * len(values))
    spectrum = np.abs(np.fft.rfft(band * weights * np.hanning(len(band)), 8 * len(values)))
    spectrum[np.abs(frequencies - share) > half_width] = 0.0
    pieces = max(round(len(values) * period_s / STEADY_S), 1)
    knots = np.linspace(0.0, len(values) - 1.0, pieces + 1)
    hats = np.stack([np.interp(index, knots, row) for row in np.eye(len(knots))], axis=1)
    angle = 2.0 * np.pi * float(frequencies[np.argmax(spectrum)]) * index[:, None]
    waves = np.concatenate([hats * np.cos(angle), hats * np.sin(angle)], axis=1)
    for _ in range(3):
        fitted = np.linalg.lstsq(waves * weights[:, None], band * weights, rcond=None)[0]
        weights = _weigh_quiet(band - waves @ fitted, share)
    sinusoid: Array = waves @ fitted / gain
    return sinusoid


HOMED_PA = 250.0
"""Homing leaves the zero within this; records that differ by more differ for another reason."""
PIECE_S = 0.05
"""Length of the pieces of a rest that are compared at the same time after the start."""
FEWEST_PIECES = 4
FEWEST_SAMPLES = 100
SURE_DRIFT = 3.0
"""A rest whose difference from the others drifts by this many sigma is no rest."""


def align_resting_pressure(records: Sequence[Record]) -> list[Record]:
    """Return the records with their sensors' zeros aligned at rest; all others as they are.

    What the records share at the same time after the start, such as a leak that fills the muscle,
    is not changed. Only rests under the same command are compared. A difference counts by how much
    it exceeds its own uncertainty; one beyond `HOMED_PA`, or one that drifts, is left.
    """
    aligned = [*records]
    resting = [k for k, record in enumerate(records) if _rests(record)]
    resting.sort(key=lambda k: records[k]["valve_v"][0])
    ends = [
        i
        for i, (one, other) in enumerate(pairwise(resting), 1)
        if records[other]["valve_v"][0] - records[one]["valve_v"][0] > REST_V
    ]
    for group in np.split(np.array(resting, dtype=int), ends):
        excesses = _measure_excesses([_average_pieces(records[k]) for k in group])
        for k, excess_pa in zip(group, excesses, strict=True):
            if excess_pa:
                aligned[k] = replace(records[k], pressure_pa=records[k]["pressure_pa"] - excess_pa)
    return aligned


def _rests(record: Record) -> bool:
    if record.valve_v is None or record.pressure_pa is None:
        return False
    rest = record.rest_samples
    return rest >= FEWEST_SAMPLES and rest * record.period_s >= FEWEST_PIECES * PIECE_S


def _average_pieces(record: Record) -> Array:
    """Return the mean pressure of each piece of the rest; NaN where it has no sample."""
    rest = slice(0, record.rest_samples)
    piece = ((record.t_s[rest] - record.t_s[0]) / PIECE_S + 1e-6).astype(int)
    counts = np.bincount(piece).astype(float)
    sums = np.bincount(piece, weights=record["pressure_pa"][rest])
    full: Array = np.divide(sums, counts, out=np.full(len(counts), np.nan), where=counts > 0.0)
    return full[:-1] if counts[-1] < 0.5 * counts[0] else full  # the last piece may be a stub


def _measure_excesses(rests: Sequence[Array]) -> Array:
    """Return by how much each rest lies above the others, shrunk by its uncertainty; or 0."""
    length = max(map(len, rests), default=0)
    table = np.full((len(rests), length), np.nan)
    for row, rest in zip(table, rests, strict=True):
        row[: len(rest)] = rest
    shared = np.isfinite(table).sum(axis=0) > 1
    if shared.sum() < FEWEST_PIECES:
        return np.zeros(len(rests))
    table = table[:, shared]
    zeros, course = _separate(table)
    zeros = zeros - np.median(zeros)
    return np.array([_shrink(zero, row - course) for zero, row in zip(zeros, table, strict=True)])


def _separate(table: Array) -> tuple[Array, Array]:
    """Return a zero for each row and the course that all rows share, by least squares."""
    rows, columns = np.nonzero(np.isfinite(table))
    design = np.zeros((len(rows), sum(table.shape)))
    entry = np.arange(len(rows))
    design[entry, rows] = design[entry, len(table) + columns] = 1.0
    found: Array = np.asarray(
        np.linalg.lstsq(design, table[rows, columns], rcond=None)[0], dtype=np.float64
    )
    return found[: len(table)], found[len(table) :]


def _shrink(zero_pa: float, difference: Array) -> float:
    """Return the part of a zero that its scatter does not explain; 0 for one that cannot be."""
    difference = difference[np.isfinite(difference)]
    if len(difference) < FEWEST_PIECES or abs(zero_pa) > HOMED_PA or zero_pa == 0.0:
        return 0.0
    # Neighbours show the noise alone, also where the pressure drifts.
    noise_pa = float(np.sqrt(0.5 * np.mean(np.diff(difference) ** 2)))
    uncertain_pa = noise_pa / np.sqrt(len(difference))
    early, late = np.array_split(difference, 2)
    if abs(np.mean(late) - np.mean(early)) > SURE_DRIFT * 2.0 * uncertain_pa:
        return 0.0
    return float(zero_pa * max(1.0 - (uncertain_pa / zero_pa) ** 2, 0.0))
