"""Terms on supply, flow and volume of the air; a plant without terms passes None."""

from __future__ import annotations

from pamctl.plant.terms.operators import (
    COMMAND,
    FLOW_AT,
    POSITION,
    SUPPLY_AT,
    TIME,
    VOLUME_AT,
    TermMemory,
    Terms,
    shape_of,
)

LOWEST_SUPPLY_PA = 1e3
LEAST_SHARE = 0.05
"""A term takes no more of the volume than this leaves."""


def pass_supply_term(terms: Terms | None, supply_pa: float, age_s: float) -> float:
    """Return the supply's absolute pressure with what the term adds."""
    if terms is None:
        return supply_pa
    term = terms.air
    if term.size == 0.0 or term.location != SUPPLY_AT:
        return supply_pa
    return max(
        supply_pa + term.size * shape_of(term, age_s, TermMemory(0.0, 0.0)), LOWEST_SUPPLY_PA
    )


def add_flow_term(
    terms: Terms | None,
    flow_kg_per_s: float,
    opening_v: float,
    gauge_pa: float,
    position_m: float,
    age_s: float,
) -> float:
    """Return the added mass flow into the muscle with what the term adds."""
    if terms is None:
        return flow_kg_per_s
    term = terms.air
    if term.size == 0.0 or term.location != FLOW_AT:
        return flow_kg_per_s
    value = gauge_pa
    if term.driver == COMMAND:
        value = opening_v
    elif term.driver == POSITION:
        value = position_m
    elif term.driver == TIME:
        value = age_s
    return flow_kg_per_s + term.size * shape_of(term, value, TermMemory(0.0, 0.0))


def pass_volume_term(
    terms: Terms | None, volume_m3: float, position_m: float, gauge_pa: float
) -> float:
    """Return the volume of the air with what the term adds."""
    if terms is None:
        return volume_m3
    term = terms.air
    if term.size == 0.0 or term.location != VOLUME_AT:
        return volume_m3
    value = position_m if term.driver == POSITION else gauge_pa
    added_m3 = term.size * shape_of(term, value, TermMemory(0.0, 0.0))
    return max(volume_m3 + added_m3, LEAST_SHARE * volume_m3)
