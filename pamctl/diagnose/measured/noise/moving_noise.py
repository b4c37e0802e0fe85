"""Noise that grows with the speed of its channel: turbulence of a flow, or samples that jitter.

It is white like the noise at rest, but its density follows the motion. A signal that is merely
lively is smoother: its higher differences show less than its lower ones. Medians within short
windows leave out the bends where a command jumps.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np

from pamctl.diagnose.measured.noise.spectrum import find_tail
from pamctl.diagnose.measured.noise.time_stamps import cut_even_stretches
from pamctl.diagnose.measured.record import Array, Record

WINDOW = 34
"""Samples whose speed counts as one."""
FAST = 0.125
"""Share of the windows that count as fast, and as slow."""
ORDERS = (3, 5)
"""Of the differences that show white noise; both show the same."""
FLAT = 1.15
"""What the lower ones show over what the higher ones do; more is a lively signal."""
UNEVEN = 2.0
"""Growth below this multiple of the scatter of the periods comes from the times of the samples."""
LOUDER = 1.6
"""Variance of the noise of fast windows over that of slow ones, from which it counts."""


def measure_growth(records: Sequence[Record], channel: str, deviation: float, step: float) -> float:
    """Return further noise over the change from one sample to the next; 0 where none shows.

    `deviation` is the noise at rest, with the rounding to `step`.
    """
    windows = _cut_windows(records, channel)
    if len(windows) < 40:
        return 0.0
    change = np.abs(windows[:, -1] - windows[:, 0]) / (WINDOW - 1)
    order = np.argsort(change)
    count = int(FAST * len(windows))
    slow, fast = windows[order[:count]], windows[order[-count:]]
    still = find_tail([*slow], WINDOW - 2)
    lower, higher = (_measure_white(fast, n) for n in ORDERS)
    if still is None or np.median(lower) > FLAT**2 * np.median(higher):
        return 0.0
    quiet = max(still.deviation**2, deviation**2, step**2 / 12.0)
    if float(np.median(higher)) - quiet < max((LOUDER - 1.0) * quiet, step**2):
        return 0.0
    # Differences do not show the slow part of a coloured noise; neither must what is taken off.
    excess = higher - max(float(np.median(_measure_white(slow, ORDERS[1]))), step**2 / 12.0)
    # A fill slows down within a window: a median of the noise belongs to a median of the speed.
    half = WINDOW // 2
    usual = np.median(np.abs(fast[:, half:] - fast[:, :-half]), axis=1) / half
    growth = float(np.sqrt(np.median(excess / usual**2)))
    # Samples that are not evenly apart look noisy as well, but their times are known.
    uneven = float(np.median([np.std(np.diff(r.step_s)) / r.period_s for r in records]))
    return growth if growth > UNEVEN * uneven else 0.0


def _measure_white(windows: Array, order: int) -> Array:
    """Return the variance of white noise in each window by its differences, shape (windows,)."""
    usual = np.median(np.abs(np.diff(windows, order, axis=1)), axis=1) / 0.6745
    return np.asarray(usual**2 / comb(2 * order, order))


def _cut_windows(records: Sequence[Record], channel: str) -> Array:
    parts = [r[channel][part] for r in records for part in cut_even_stretches(r)]
    whole = [p[: len(p) // WINDOW * WINDOW].reshape(-1, WINDOW) for p in parts]
    return np.concatenate(whole) if whole else np.zeros((0, WINDOW))
