"""Butterworth filters of second order, run forwards and backwards: no delay.

They are applied in the frequency domain. `scipy.signal` has them too, but takes most of a second to
import.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from pamctl.diagnose.measured.record import Array

MIRRORED_PERIODS = 4.0
"""Mirrored periods of a cutoff at each end: a low-pass's answer has faded by then to 1e-7."""


def respond_low_pass(share: Array, cutoff: float) -> Array:
    """Return what passes at frequencies, by the trapezoidal rule; all in cycles per sample."""
    passed: Array = 1.0 / (1.0 + (np.tan(np.pi * share) / np.tan(np.pi * cutoff)) ** 4)
    return passed


def respond_band_pass(share: Array, low: float, high: float) -> Array:
    """Return what a band passes at frequencies; all in cycles per sample."""
    warped, low, high = np.tan(np.pi * share), np.tan(np.pi * low), np.tan(np.pi * high)
    inside, outside = ((high - low) * warped) ** 4, (warped**2 - low * high) ** 4
    passed: Array = inside / (inside + outside)
    return passed


def smooth_below(values: Array, cutoff: float) -> Array:
    """Return evenly sampled values without what is faster than a cutoff, in cycles per sample.

    The ends are mirrored. Otherwise the filter starts from a single noisy sample, and the muscle at
    rest follows every pascal of it.
    """
    whole, inside = _mirror(values, round(MIRRORED_PERIODS / cutoff))
    return _apply(whole, respond_low_pass(rfftfreq(len(whole)), cutoff))[inside]


def pass_band(values: Array, low: float, high: float) -> Array:
    """Return what lies between two frequencies, in cycles per sample."""
    whole, inside = _mirror(values, round(MIRRORED_PERIODS / (high - low)))
    return _apply(whole, respond_band_pass(rfftfreq(len(whole)), low, high))[inside]


def _mirror(values: Array, mirrored: int) -> tuple[Array, slice]:
    """Return the values with mirrored ends, of a length that is quickly transformed; and where
    the values are.
    """
    length = next_fast_len(len(values) + 2 * mirrored, real=True)
    whole = np.pad(values, (mirrored, length - len(values) - mirrored), mode="reflect")
    return whole, slice(mirrored, mirrored + len(values))


def _apply(values: Array, response: Array) -> Array:
    filtered: Array = irfft(rfft(values) * response, len(values))
    return filtered
