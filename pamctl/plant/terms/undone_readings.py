"""Readings without the term of a sensor; for drives, which are compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pamctl.kernel.calls import machine
from pamctl.plant.terms.operators import Terms
from pamctl.plant.terms.sensor_terms import show_position_term, show_pressure_term

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

ROUNDS = 3
"""A term changes a reading by little: what is behind it is found in so many rounds."""


def undo_reading_term(
    place: str, terms: Terms | None, shown: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the readings of sensors without the term; `place` is that of the effects."""
    if terms is None or terms.sensors.size == 0.0:
        return shown
    true = shown.copy()
    machine(fill_undone)(place == "pressure_reading", terms, shown, times_s, atmosphere_pa, true)
    return true


def fill_undone(
    is_pressure: bool,
    terms: Terms,
    shown: Array,
    times_s: Array,
    atmosphere_pa: float,
    true: Array,
) -> None:
    """Kernel of `undo_reading_term`: find what the term turns into each reading."""
    for k in range(len(shown)):
        for _ in range(ROUNDS):
            if is_pressure:
                again = show_pressure_term(terms, true[k], atmosphere_pa, times_s[k])
            else:
                again = show_position_term(terms, true[k], times_s[k])
            true[k] -= again - shown[k]
