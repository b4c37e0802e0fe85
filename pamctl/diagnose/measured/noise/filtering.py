"""Filtered channels: somebody smoothed them, so they look quieter than their sensor is.

A filter leaves its edge in the spectrum, or nothing at all above it. If it ran forwards and
backwards, it has no delay: a step then begins before its cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pamctl.diagnose.measured.noise.spectrum import find_cutoff, find_tail
from pamctl.diagnose.measured.noise.time_stamps import cut_even_stretches
from pamctl.diagnose.measured.record import Array, Record
from pamctl.log.record_problems import find_sensor_step

QUIETEST = 1e-6
"""No sensor's noise is smaller than this share of the channel's span: less is a filter's work."""
STILL_S, AFTER_S = 0.1, 0.05
"""A step of the command counts if it rested this long before; the answer is taken after it."""
BEFORE_CUTOFF = 0.15
"""A filter without delay shows a step this many periods of its cutoff ahead."""
LEAST_AHEAD = 0.005
"""Share of the answer that must be there before its cause."""
FEWEST_STEPS = 3
FEWEST_AT_REST = 256
"""Samples of a rest that show an edge in its noise."""


class Filtering(NamedTuple):
    """How a channel was filtered."""

    cutoff_hz: float | None
    """Where its spectrum is cut off; None if no edge is visible."""
    is_zero_phase: bool
    """A step begins before its cause, as a filter does that runs forwards and backwards."""


def find_filtering(records: Sequence[Record], channel: str) -> Filtering | None:
    """Return how a channel was filtered; None if it shows no sign of that."""
    pieces = [r[channel][part] for r in records for part in cut_even_stretches(r)]
    tail = find_tail(pieces)
    span = max(float(np.ptp(r[channel])) for r in records)
    period_s = records[0].period_s
    step = max(find_sensor_step(r[channel]) for r in records)
    if tail is not None and tail.is_flat and tail.deviation > max(QUIETEST * span, 0.4 * step):
        return None  # a filter would have taken this noise away
    rests = [r[channel][: r.rest_samples] for r in records]
    share = find_cutoff([rest for rest in rests if len(rest) >= FEWEST_AT_REST])
    is_too_quiet = False
    if not step:  # a converter's steps end a spectrum as a filter's edge does
        share = share or find_cutoff(pieces)
        is_too_quiet = tail is not None and tail.deviation < QUIETEST * span
    if share is None and not is_too_quiet:
        return None
    cutoff_hz = None if share is None else share / period_s
    return Filtering(cutoff_hz, _is_ahead(records, channel, cutoff_hz))


def _is_ahead(records: Sequence[Record], channel: str, cutoff_hz: float | None) -> bool:
    """Tell whether a channel answers steps of the command before they come."""
    shares = np.array(
        [
            share
            for record in records
            if record.valve_v is not None
            for share in _measure_ahead(record, channel, cutoff_hz)
        ]
    )
    if len(shares) < FEWEST_STEPS:
        return False
    error = float(shares.std(ddof=1)) / np.sqrt(len(shares))
    return bool(np.median(shares) > LEAST_AHEAD and shares.mean() > 3.0 * error)


def _measure_ahead(record: Record, channel: str, cutoff_hz: float | None) -> list[float]:
    """Return, for each step of the command, the share of the answer that comes before it."""
    command, values = record["valve_v"], record[channel]
    period_s = record.period_s
    still, after = round(STILL_S / period_s), max(round(AFTER_S / period_s), 1)
    clear = round(min(0.5 / (cutoff_hz or 30.0), 0.5 * STILL_S) / period_s)
    last = round(BEFORE_CUTOFF / (cutoff_hz or 30.0) / period_s)
    least = 0.2 * float(np.ptp(command))
    shares = []
    for jump in (np.flatnonzero(np.abs(np.diff(command)) > max(least, 1e-9)) + 1).tolist():
        if jump < still or jump + after >= len(record) or np.ptp(command[jump - still : jump]):
            continue
        before = _extend_line(values[jump - still : jump - clear], clear - last)
        whole = float(values[jump + after] - before)
        if whole:
            shares.append(float(values[jump - last] - before) / whole)
    return shares


def _extend_line(values: Array, by: int) -> float:
    """Return where the straight line through some values is, so many samples later."""
    index = np.arange(len(values), dtype=np.float64)
    return float(np.polynomial.Polynomial.fit(index, values, 1)(len(values) - 1.0 + by))
