"""Stretches of a record without a gap, and filters whose length is a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import factorial

import numpy as np

from pamctl.diagnose.measured import zero_phase
from pamctl.diagnose.measured.missed_ticks import smooth_over_missed
from pamctl.diagnose.measured.record import Array
from pamctl.log.cut import find_longest_step_s

STROKE_END = 0.1
"""Share of a stroke that is left out at each end."""
CUBIC_S = 0.015
"""Length of the cubic that smooths a position: 15 samples at 1 kHz."""


def find_segments(step_s: Array) -> tuple[slice, ...]:
    """Return the stretches between gaps, as slices of the samples; `step_s` has shape (n - 1,)."""
    longest_s = find_longest_step_s(step_s, holds_command=True)
    ends = [0, *(int(row) + 1 for row in np.flatnonzero(step_s > longest_s)), len(step_s) + 1]
    return tuple(slice(a, b) for a, b in pairwise(ends))


def filter_segments(
    values: Array, step_s: Array, of_even: Callable[[Array], Array], short: float | None = None
) -> Array:
    """Apply a filter of evenly spaced samples, over missed ticks but not over gaps, shape (n,).

    A stretch of one or two samples is left as it is, or set to `short`.
    """
    result = values.copy()
    for part in find_segments(step_s):
        if part.stop - part.start > 2:
            inside_s = step_s[part.start : part.stop - 1]
            result[part] = smooth_over_missed(values[part], inside_s, of_even)
        elif short is not None:
            result[part] = short
    return result


def count_samples(length_s: float, period_s: float) -> int:
    """Return the odd number of samples nearest to a filter's length, at least one."""
    return 2 * round(0.5 * (length_s / period_s - 1.0)) + 1 if length_s > period_s else 1


def smooth_by_cubic(values: Array, period_s: float, length_s: float = CUBIC_S) -> Array:
    """Smooth by local cubics over `length_s`; where that is too short for a cubic, do nothing."""
    samples = min(count_samples(length_s, period_s), 2 * ((len(values) - 1) // 2) + 1)
    if samples < 5:
        return values
    return _fit_polynomials(values, samples, 3)


def smooth_below(values: Array, period_s: float, cutoff_hz: float) -> Array:
    """Smooth without delay by a filter of second order in both directions."""
    relative = 2.0 * cutoff_hz * period_s
    if relative >= 0.9 or len(values) < 3:  # also without a cutoff, at infinity
        return values
    return zero_phase.smooth_below(values, cutoff_hz * period_s)


def differentiate(values: Array, period_s: float, length_s: float, order: int) -> Array:
    """Return the derivative of local parabolas over `length_s`; zeros where there is no room."""
    samples = min(max(count_samples(length_s, period_s), 5), 2 * ((len(values) - 1) // 2) + 1)
    if samples < 3:
        return np.zeros(len(values))
    return _fit_polynomials(values, samples, 2, order) / period_s**order


def _fit_polynomials(values: Array, samples: int, degree: int, order: int = 0) -> Array:
    """Return the values of polynomials through `samples` neighbours, or derivatives by the sample.

    At the ends it is the polynomial of the first or last samples (Savitzky and Golay, 1964).
    """
    half = samples // 2
    powers = np.vander(np.arange(-half, half + 1.0), degree + 1, increasing=True)
    fits = np.linalg.pinv(powers)  # of the polynomial, from the samples
    result = np.empty(len(values))
    # `convolve` turns the weights round.
    result[half : len(values) - half] = np.convolve(
        values, factorial(order) * fits[order, ::-1], mode="valid"
    )
    for inside, ends, middle in (
        (slice(0, samples), slice(0, half), half),
        (slice(-samples, None), slice(len(values) - half, None), len(values) - 1 - half),
    ):
        polynomial = np.polynomial.Polynomial(fits @ values[inside])
        at = np.arange(len(values))[ends] - middle
        result[ends] = polynomial.deriv(order)(at) if order else polynomial(at)
    return result


def slope_gain(length_s: float, period_s: float, order: int = 1) -> float:
    """Return the noise of `differentiate` over that of the signal, for white noise (1/s^order)."""
    n = float(max(count_samples(length_s, period_s), 5))
    if order == 1:
        return float(np.sqrt(12.0 / (n * (n**2 - 1.0)))) / period_s
    return float(np.sqrt(720.0 / (n * (n**2 - 1.0) * (n**2 - 4.0)))) / period_s**2


def find_strokes(direction: Array, segments: Sequence[slice], edge: int) -> tuple[slice, ...]:
    """Return the stretches of one direction, without their ends.

    `direction` is 1, -1 or, at rest, 0, shape (n,). A tenth of a stroke is left out at both ends,
    or `edge` samples if that is more: about a reversal seals and drives bend before they slide, and
    the parabolas that differentiate the motion bend over it.
    """
    strokes = []
    for part in segments:
        turns = np.flatnonzero(np.diff(direction[part])) + 1 + part.start
        for start, stop in pairwise([part.start, *(int(turn) for turn in turns), part.stop]):
            left_out = max(round(STROKE_END * (stop - start)), edge)
            if direction[start] and stop - start > 2 * left_out:
                strokes.append(slice(start + left_out, stop - left_out))
    return tuple(strokes)
