"""Single outliers and dropouts: samples that no rig can have made, since it would have to return.

A spike leaves the signal and is back a moment later; so does a reading of zero or of full scale.
A step, a click of dry friction or a burst of noise is not back, or is as busy before and after.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pamctl.diagnose.measured.record import Array, Record
from pamctl.log.record_problems import find_sensor_step

Rows = NDArray[np.bool_]
Counts = NDArray[np.intp]

LONGEST = 20
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
    for stop in range(start + 1, min(start + LONGEST, len(values) - AROUND) + 1):
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
        if least <= stop - start <= LONGEST and all(
            _measure_noise(p) > 0.3 * usual for p in around
        ):
            yield start + 1, stop + 1


def _measure_noise(part: Array) -> float:
    """Return the usual noise of a stretch; a held value has none, and a single spike adds none."""
    if len(part) < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(part, 3))) / (0.6745 * np.sqrt(20.0)))
