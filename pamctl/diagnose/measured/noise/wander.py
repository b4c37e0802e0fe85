"""A zero that wanders: slow noise that a rest shows beside the fast one.

The cosine modes of white noise are all of one size, and those of a random walk fall with their
number. What moves at a rest by physics, such as the end of a venting, is smooth: a cubic takes it
away.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.fft import dct

from pamctl.diagnose.measured.record import Array

SLOW = slice(5, 15)
"""Modes (half waves in a rest) that a cubic leaves, and that show a walk best."""
WHITE = slice(20, 40)
"""Modes that show the faster noise; one with a memory of milliseconds counts as white here."""
FEWEST = 400
"""Samples of a rest, at least."""
SURE = 5.0
"""A walk counts if the slow modes exceed the faster ones by so many of their own scatters."""


def measure_walk(rests: Sequence[Array]) -> float:
    """Return the standard deviation of the zero's random step from one sample to the next.

    `rests` are stretches of one channel at rest; 0 where no walk is sure.
    """
    modes, shapes = [], []
    for rest in (rest for rest in rests if len(rest) >= FEWEST):
        modes.append(dct(_remove_cubic(rest), norm="ortho") ** 2)
        angles = np.pi * np.arange(SLOW.start, SLOW.stop) / len(rest)
        shapes.append(1.0 / (2.0 * np.sin(0.5 * angles)) ** 2)
    if not modes:
        return 0.0
    white = float(np.mean([m[WHITE] for m in modes]))
    slow = np.array([m[SLOW] for m in modes])
    excess = float(slow.mean()) - white
    if white <= 0.0 or excess < SURE * white * np.sqrt(2.0 / slow.size):
        return 0.0
    return float(np.sqrt(excess / np.mean(shapes)))


def remove_walk(rest: Array) -> Array:
    """Return a rest without its slow modes."""
    modes = dct(_remove_cubic(rest), norm="ortho")
    modes[: SLOW.stop] = 0.0
    return np.asarray(dct(modes, type=3, norm="ortho"))


def _remove_cubic(rest: Array) -> Array:
    index = np.arange(len(rest), dtype=np.float64)
    return np.asarray(rest - np.polynomial.Polynomial.fit(index, rest, 3)(index))
