"""Terms on the readings of the pressure sensor and the encoder; without terms they pass None."""

from __future__ import annotations

from pamctl.plant.terms.operators import (
    ENCODER_AT,
    PRESSURE_SENSOR_AT,
    TIME,
    TermMemory,
    Terms,
    shape_of,
)


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
