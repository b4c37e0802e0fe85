"""Terms on the readings of the pressure sensor and the encoder; without terms they pass None."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pamctl.plant.terms.operators import (
    ENCODER_AT,
    PRESSURE_SENSOR_AT,
    TIME,
    TermMemory,
    Terms,
    shape_of,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

ROUNDS = 3
"""A term changes a reading by little: what is behind it is found in so many rounds."""


def show_pressure_term(
    terms: Terms | None, shown_pa: float, atmosphere_pa: float, age_s: float
) -> float:
    """Return the pressure that the sensor shows, with what the term adds."""
    if terms is None:
        return shown_pa
    term = terms.sensors
    if term.size == 0.0 or term.location != PRESSURE_SENSOR_AT:
        return shown_pa
    value = age_s if term.driver == TIME else shown_pa - atmosphere_pa
    return shown_pa + term.size * shape_of(term, value, TermMemory(0.0, 0.0))


def show_position_term(terms: Terms | None, shown_m: float, age_s: float) -> float:
    """Return the displacement that the encoder shows, with what the term adds."""
    if terms is None:
        return shown_m
    term = terms.sensors
    if term.size == 0.0 or term.location != ENCODER_AT:
        return shown_m
    value = age_s if term.driver == TIME else shown_m
    return shown_m + term.size * shape_of(term, value, TermMemory(0.0, 0.0))


def undo_reading_term(
    place: str, terms: Terms | None, shown: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the readings of sensors without the term; `place` is that of the effects."""
    if terms is None or terms.sensors.size == 0.0:
        return shown
    from pamctl.compiled import compile_kernel  # the loop's process never calls this

    true = shown.copy()
    compile_kernel(fill_undone)(place == "pressure_reading", terms, shown, times_s, atmosphere_pa, true)
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
