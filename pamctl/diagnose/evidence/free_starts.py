"""The state in which a piece of a record begins: no sensor shows it exactly, so it is fitted.

After a gap, or in a record that begins in motion, a rig behind a valve begins with measured values,
which are late, noisy or rounded, and a closed chamber never forgets them. What another start would
have changed is found once, by simulations with each state pushed. The response is linear for small
pushes, so every model gets the start that fits it best by least squares, and no law is named for
what the start left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.plant.parameters import PlantParameters, PlantState, rest_state

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOST_PUSHES = 100.0
"""A start that lies farther away is not one that a sensor could have shown."""
SINGULAR = 1e-3
"""A combination of pushes that shows less than this share of the largest is not fitted."""


class StartPush(NamedTuple):
    """A change of the state in which a piece begins."""

    position_m: float = 0.0
    speed_m_per_s: float = 0.0
    pressure_pa: float = 0.0


STILL = StartPush()
PUSHES = (StartPush(position_m=2e-5), StartPush(speed_m_per_s=1e-3), StartPush(pressure_pa=200.0))


class FreeStart(NamedTuple):
    """One piece: where it lies among all samples, and what each push changes there."""

    where: slice
    changes: Array
    """Shape (pushes, channels, samples)."""
    solves: Array
    """From a residual to pushes, shape (pushes, channels * samples); masked samples count 0."""


def push_start(
    p: PlantParameters, position_m: float, pressure_pa: float, push: StartPush
) -> PlantState:
    """Return a plant that has rested at a position and pressure, and then was pushed."""
    start = rest_state(p, position_m + push.position_m, pressure_pa + push.pressure_pa)
    return start if push == STILL else start._replace(velocity_m_per_s=push.speed_m_per_s)


def find_start(at: int, changes: Array, shown: Array, masked: Mask) -> FreeStart:
    """Return the free start of a piece whose first sample is number `at` of all.

    `changes` have the shape (pushes, channels, samples), `shown` and `masked` that of a push. A
    channel weighs by its usual change of slope, which is its noise or its step.
    """
    steps = np.mean(np.abs(np.diff(shown, 2)), axis=1) + 1e-12 * np.ptp(shown, axis=1) + 1e-30
    table = np.where(masked, 0.0, changes / steps[:, None]).reshape(len(changes), -1)
    size = np.sqrt(np.sum(table**2, axis=1)) + 1e-30
    solves = np.linalg.pinv((table / size[:, None]).T, rcond=SINGULAR) / size[:, None]
    solves = (solves.reshape(changes.shape) / steps[:, None]).reshape(len(changes), -1)
    where = slice(at, at + shown.shape[1])
    return FreeStart(where, changes, np.where(masked.ravel(), 0.0, solves))


def fit_starts(starts: Sequence[FreeStart], shown: Array, rows: Array) -> Array:
    """Move the readings of a simulation to the starts that fit best, in place."""
    measured, simulated = (each.reshape(len(rows), -1) for each in (shown, rows))
    for where, changes, solves in starts:
        off = measured[:, where] - simulated[:, where]
        pushes = np.clip(solves @ off.ravel(), -MOST_PUSHES, MOST_PUSHES)
        simulated[:, where] += np.tensordot(pushes, changes, 1)
    return rows
