"""Windows of a record: each starts from the measured state, and its start's error does not count.

A mass without a spring never forgets its start, and adds up every small force. A free run then
drifts away, and what is judged is the drift. In a short window the drift is small. The start of
a window is estimated from the window's own first samples, so that a simulated record is treated
exactly like a measured one. What an error of the start moves is projected out of the residual, to
first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.measured.record import Array
from pamctl.plant.drive import Restarts

FEWEST_SAMPLES = 8
"""A shorter window tells nothing but its own start."""
SHORTEST_TIME_S = 1e-9
START_SHARE = 0.2
"""Share of a window from which its start is estimated."""
LONGEST_START_S = 0.02
"""More than this of a window is not used for its start: the acceleration may change."""
START_SAMPLES = (5, 7, 10, 14, 20, 28, 40, 56, 80, 112, 160, 224)
"""Samples that are tried for a start."""
CHANCE = 2.0
"""A start rests if its samples scatter by the noise and this many sigma of chance, or less."""
FITS = 1.5
"""A parabola fits if it leaves less than this multiple of the noise."""


def cut_windows(segments: Sequence[slice], samples: int) -> tuple[slice, ...]:
    """Cut each segment into equal windows of about `samples`; leave out segments that are short."""
    windows = []
    for segment in segments:
        length = segment.stop - segment.start
        if length < FEWEST_SAMPLES:
            continue
        count = max(round(length / max(samples, FEWEST_SAMPLES)), 1)
        ends = np.linspace(segment.start, segment.stop, count + 1).round().astype(int)
        windows += [slice(int(a), int(b)) for a, b in pairwise(ends)]
    return tuple(windows)


def find_rows_inside(windows: Sequence[slice], samples: int) -> NDArray[np.bool_] | None:
    """Return which samples lie in a window, shape (samples,); None for all."""
    inside = np.zeros(samples, dtype=bool)
    for window in windows:
        inside[window] = True
    return None if inside.all() else inside


def estimate_starts(
    times_s: Array, measured: Array, windows: Sequence[slice], deviation: float
) -> Restarts:
    """Estimate value and rate at the first sample of each window, by a parabola.

    `times_s` and `measured` have shape (n,); `deviation` is that of the noise. The parabola covers
    as many samples as it fits within the noise: the acceleration may jump. Where a constant fits
    all of them, the start rests: friction at rest is another than in the slowest motion.
    """
    rows = np.array([window.start for window in windows], dtype=np.int64)
    values, rates = np.zeros(len(windows)), np.zeros(len(windows))
    ends = np.array([window.stop for window in windows], dtype=np.int64)
    room = START_SHARE * (ends - rows)
    for samples in START_SAMPLES:
        near = rows + samples <= ends
        if samples > START_SAMPLES[0]:
            took_s = times_s[np.minimum(rows + samples, len(times_s)) - 1] - times_s[rows]
            near &= (samples <= room) & (took_s <= LONGEST_START_S)
        if not near.any():
            break
        index = np.add.outer(rows[near], np.arange(samples))
        since_s = times_s[index] - times_s[index[:, :1]]
        shown = measured[index]
        fitted, left = _fit_parabolas(since_s, shown)
        good = (left <= FITS * deviation) | (samples == START_SAMPLES[0])
        by_chance = 1.0 + CHANCE / np.sqrt(2.0 * samples)
        still = np.std(shown, axis=1) <= by_chance * deviation
        chosen = np.flatnonzero(near)[good]
        values[chosen] = np.where(still, shown.mean(axis=1), fitted[:, 0])[good]
        rates[chosen] = np.where(still, 0.0, fitted[:, 1])[good]
    return Restarts(rows, values, rates)


def _fit_parabolas(since_s: Array, shown: Array) -> tuple[Array, Array]:
    """Return value, rate and bend at the start of each row, and the deviation from them."""
    span_s = since_s[:, -1:, None]
    powers = np.stack([np.ones_like(since_s), since_s, since_s**2], axis=2)
    scale = np.concatenate([np.ones_like(span_s), span_s, span_s**2], axis=2)
    basis, triangle = np.linalg.qr(powers / scale)
    fitted = np.linalg.solve(triangle, np.einsum("wnm,wn->wm", basis, shown)[:, :, None])[:, :, 0]
    left = shown - np.einsum("wnm,wm->wn", powers / scale, fitted)
    freedom = shown.shape[1] - 3
    return fitted / scale[:, 0], np.sqrt(np.sum(left**2, axis=1) / freedom)


@dataclass(frozen=True)
class StartModes:
    """What errors of the starts move, as an orthonormal basis for each window."""

    groups: tuple[tuple[NDArray[np.int64], Array], ...]
    """For each length of window: the samples, shape (windows, length), and the basis, shape
    (windows, length, modes)."""

    def project_out(self, error: Array) -> Array:
        """Return an error, shape (n,), without what errors of the starts explain of it."""
        rest = error.copy()
        for rows, basis in self.groups:
            part = rest[rows]
            amounts = np.einsum("wlm,wl->wm", basis, part)
            rest[rows] = part - np.einsum("wlm,wm->wl", basis, amounts)
        return rest


def build_start_modes(
    times_s: Array, windows: Sequence[slice], velocity_time_s: float | None
) -> StartModes:
    """Build the modes: a constant and, with `velocity_time_s`, the way of a dying velocity.

    A velocity that friction damps with a time constant T goes 1 - exp(-t / T) of its way; without
    friction, T infinite, that is a line.
    """
    lengths = {window.stop - window.start for window in windows}
    groups = []
    for length in sorted(lengths):
        firsts = [w.start for w in windows if w.stop - w.start == length]
        rows = np.add.outer(np.array(firsts, dtype=np.int64), np.arange(length))
        since_s = times_s[rows] - times_s[rows[:, :1]]
        columns = [np.ones_like(since_s)]
        if velocity_time_s is not None:
            way_s = since_s
            if np.isfinite(velocity_time_s):
                way_s = -np.expm1(-since_s / max(velocity_time_s, SHORTEST_TIME_S))
            columns.append(way_s / np.max(way_s, initial=SHORTEST_TIME_S))
        groups.append((rows, np.linalg.qr(np.stack(columns, axis=2))[0]))
    return StartModes(tuple(groups))
