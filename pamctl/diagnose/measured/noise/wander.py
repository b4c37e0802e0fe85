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
COMPARED = slice(5, 40)
"""Modes that tell a walk from white noise; a memory of milliseconds counts as white here."""
FEWEST = 400
"""Samples of a rest, at least."""
SURE = 6.0
"""A walk counts if the modes are exp(6) times as likely with it: 1 of 2000 without a walk are."""
_SHARES = np.geomspace(1e-6, 1e2, 60)
"""Squared steps of a walk that are asked, over the density of the white noise."""


def measure_walk(rests: Sequence[Array]) -> float:
    """Return the standard deviation of the zero's random step from one sample to the next.

    `rests` are stretches of one channel at rest; 0 where no walk is sure. Each mode's square is
    its density times a chi-squared number of one degree of freedom (Whittle's likelihood).
    """
    long = [rest for rest in rests if len(rest) >= FEWEST]
    if not long:
        return 0.0
    powers = np.concatenate([dct(_remove_cubic(r), norm="ortho")[COMPARED] ** 2 for r in long])
    if not powers.all():
        return 0.0
    densities = 1.0 + _SHARES[:, None] * np.concatenate([_walk_density(len(r)) for r in long])
    white = np.mean(powers / densities, axis=1)
    likelihood = -0.5 * (np.log(densities).sum(axis=1) + len(powers) * np.log(white))
    best = int(np.argmax(likelihood))
    without = -0.5 * len(powers) * np.log(np.mean(powers))
    if likelihood[best] - without < SURE:
        return 0.0
    return float(np.sqrt(white[best] * _SHARES[best]))


def _walk_density(samples: int) -> Array:
    """Return the squared modes of a walk of unit steps, on the compared modes."""
    angles = np.pi * np.arange(COMPARED.start, COMPARED.stop) / samples
    return 1.0 / (2.0 * np.sin(0.5 * angles)) ** 2


def remove_walk(rest: Array) -> Array:
    """Return a rest without its slow modes."""
    modes = dct(_remove_cubic(rest), norm="ortho")
    modes[: SLOW.stop] = 0.0
    return np.asarray(dct(modes, type=3, norm="ortho"))


def _remove_cubic(rest: Array) -> Array:
    index = np.arange(len(rest), dtype=np.float64)
    return np.asarray(rest - np.polynomial.Polynomial.fit(index, rest, 3)(index))
