"""The tail of a channel's spectrum: where it is flat, it is noise; otherwise nobody can tell.

A sensor's white noise has the same density at all frequencies, and a motion has ever less at high
ones. So the density just below half the sampling rate shows the noise, although the rig moves. It
does not where the signal is alive up to there, or where somebody filtered the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from pamctl.diagnose.measured.record import Array

FEWEST = 96
"""Samples of a channel below which its spectrum says nothing."""
LAST = 0.97
"""Share of half the sampling rate above which the density is not used."""
TOP = 0.7
"""The tail begins here, as a share of half the sampling rate."""
ABOVE_TAIL = 4.0
"""Where the density is more than this above the tail, it is the signal's alone."""
NARROWEST = 0.25
"""Least width of a plateau, as a share of the band."""
MOST_COLOUR = 0.12
"""Share of the tail's density that may belong to the signal's own decay."""
LIVELY, WIDE = 0.1, 0.8
"""Noise that makes up more of a channel's variance is told from a signal only by a wide plateau."""
STEEP = 6.5
"""A density that falls by more powers of two in an octave, just after a slower fall, was cut off by
a filter: a force that switches makes a motion that falls by four."""
FAINT = 1e-3
"""Most of a channel's power that may lie beyond a filter's edge: the rest is the motion."""
SHELF = 3.0
"""Powers of two by which the noise before a filter's edge falls in an octave, at most."""


@dataclass(frozen=True)
class Tail:
    """What the end of a spectrum shows."""

    deviation: float
    """Standard deviation of white noise with the density of the tail."""
    is_flat: bool
    """The tail is a plateau."""
    uncertainty: float
    """Of `deviation`, relative, one sigma."""
    begins: float = 0.5
    """Where the signal ends in it, as a share of the sampling rate; 0.5 without a plateau."""


def find_tail(pieces: Sequence[Array], window: int = 0) -> Tail | None:
    """Return the tail of the spectrum of evenly sampled stretches; None if there is too little.

    The density is the median over short windows, so that a few steps or spikes do not count.
    `window` is their length in samples; 0 chooses it by the number of samples.
    """
    samples = sum(map(len, pieces))
    window = window or (128 if samples >= 2000 else 64 if samples >= 500 else 32)
    found = measure_density(pieces, window)
    if found is None or samples < FEWEST:
        return None
    density, windows = found
    index = np.arange(len(density))
    last = int(LAST * (len(density) - 1))
    top = slice(int(TOP * (len(density) - 1)), last + 1)
    level = float(np.mean(density[top]))
    if level <= 0.0:
        return Tail(0.0, False, 0.0)
    high = np.flatnonzero(density[: last + 1] > ABOVE_TAIL * level)
    first = max(int(high[-1]) + 1 if len(high) else 0, 4)  # the first bins hold the trend
    width = (last + 1 - first) / len(density)
    effective = max(0.5 * min(windows * window / 4.0, samples) * width, 1.0)
    uncertainty = float(1.0 / np.sqrt(2.0 * effective))
    if width < NARROWEST:
        return Tail(float(np.sqrt(level)), False, uncertainty)
    # A random walk's density is one over (2 - 2 cos), also where sampling folds it.
    walk = 1.0 / (2.0 - 2.0 * np.cos(np.pi * index[first : last + 1] / (len(density) - 1)))
    part = density[first : last + 1]
    terms = np.column_stack([np.ones_like(walk), walk, walk**2, walk**4])
    expected = part
    for _ in range(3):  # the scatter of a density is in proportion to what is expected of it
        shares = nnls(terms / expected[:, None], part / expected)[0]
        expected = np.maximum(terms @ shares, 1e-3 * level)
    white = float(shares[0])
    is_flat = white >= (1.0 - MOST_COLOUR - uncertainty) * level
    if white > LIVELY * _variance(pieces):  # most of it is noise, or the signal is alive throughout
        is_flat &= width >= WIDE
    begins = 0.5 * first / (len(density) - 1)
    return Tail(float(np.sqrt(white if is_flat else level)), is_flat, uncertainty, begins)


def _variance(pieces: Sequence[Array]) -> float:
    return float(np.mean([np.var(piece) for piece in pieces]))


def measure_density(pieces: Sequence[Array], window: int) -> tuple[Array, int] | None:
    """Return the density, shape (window // 2 + 1,), and in how many windows it was measured.

    White noise's density is its variance. None if no stretch is as long as a window.
    """
    cut = [_cut_windows(piece, window) for piece in pieces if len(piece) >= window + 2]
    if not cut:
        return None
    parts = np.concatenate(cut)
    # Differences first: what is slow would leak into the tail, however good the window.
    curvature = np.diff(parts, 2, axis=1)
    shape = _shape_window(window)
    spectra = np.abs(np.fft.rfft(curvature * shape, axis=1)) ** 2 / np.sum(shape**2)
    angle = np.linspace(0.0, np.pi, window // 2 + 1)[1:]
    spectra[:, 1:] /= (2.0 - 2.0 * np.cos(angle)) ** 2
    # Densities are distributed as chi-square of two degrees: the median is log 2 of the mean.
    return _debiased_median(spectra), len(parts)


def _shape_window(samples: int) -> Array:
    """Return the window of Blackman and Harris with four terms, for a period of samples."""
    turn = 2.0 * np.pi * np.arange(samples) / samples
    weights = (0.35875, -0.48829, 0.14128, -0.01168)
    shape: Array = sum(w * np.cos(k * turn) for k, w in enumerate(weights)) + np.zeros(samples)
    return shape


def _debiased_median(spectra: Array) -> Array:
    windows = len(spectra)
    # Median of an exponential distribution for few draws, which is not yet log 2.
    odd = windows if windows % 2 else windows + 1
    harmonic = float(np.sum(1.0 / np.arange((odd + 1) // 2, odd + 1)))
    median: Array = np.median(spectra, axis=0) / harmonic
    return median


def _cut_windows(piece: Array, window: int) -> Array:
    view = np.lib.stride_tricks.sliding_window_view(piece, window + 2)
    return np.asarray(view[:: window // 4])


def find_cutoff(pieces: Sequence[Array]) -> float | None:
    """Return where a filter cut off the spectrum, as a share of the sampling rate; None if nowhere.

    The density falls steeply there, from a shelf of noise that is far below the motion's power.
    """
    octaves = _measure_octaves(pieces)
    if octaves is None:
        return None
    shares, levels, beyond = octaves
    for k in range(2, len(shares) - 2):
        before, after = levels[k - 2] - levels[k], levels[k] - levels[k + 2]
        if after >= STEEP and before <= SHELF and beyond[k] < FAINT:
            return float(shares[k])
    return None


def falls_steeply(pieces: Sequence[Array]) -> bool:
    """Tell whether the density falls anywhere as steeply as behind a filter's edge."""
    octaves = _measure_octaves(pieces)
    return octaves is not None and bool(np.any(octaves[1][:-2] - octaves[1][2:] >= STEEP))


def _measure_octaves(pieces: Sequence[Array]) -> tuple[Array, Array, Array] | None:
    """Return half-octaves: frequency over sampling rate, log2 of the density, power beyond."""
    longest = max(map(len, pieces), default=0)
    window = 1 << min(int(np.log2(max(longest - 2, 1))), 10)
    found = measure_density(pieces, window) if window >= 128 else None
    if found is None:
        return None
    density = found[0]
    beyond = np.cumsum(density[:0:-1])[::-1] / max(float(np.sum(density[1:])), 1e-300)
    centres = 8.0 * np.sqrt(2.0) ** np.arange(int(2 * np.log2(len(density) / 8.0)))
    levels = [float(np.median(density[int(c / 1.09) : int(c * 1.09) + 1])) for c in centres]
    return (
        centres / window,
        np.log2(np.maximum(levels, 1e-300)),
        beyond[centres.astype(int) - 1],
    )
