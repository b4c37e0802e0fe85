"""Terms between the command and the valve's opening; a plant without terms passes None."""

from __future__ import annotations

from pamctl.plant.terms.operators import (
    COMMAND_AT,
    EXHAUSTING_AT,
    FILLING_AT,
    OPENING_AT,
    TIME,
    TermMemory,
    Terms,
    follow_value,
    shape_of,
)


def pass_command_term(
    terms: Terms | None, memory: TermMemory | None, command_v: float, age_s: float
) -> float:
    """Return the command with what the term adds, V."""
    if terms is None or memory is None:
        return command_v
    term = terms.valve
    if term.size == 0.0 or term.location != COMMAND_AT:
        return command_v
    value = age_s if term.driver == TIME else command_v
    return command_v + term.size * shape_of(term, value, memory)


def follow_command_term(
    terms: Terms | None, memory: TermMemory | None, command_v: float, step_s: float
) -> TermMemory | None:
    """Return the memory after a step of constant command."""
    if terms is None or memory is None:
        return memory
    return follow_value(terms.valve, memory, command_v, command_v, step_s)


def pass_opening_term(terms: Terms | None, opening_v: float, age_s: float) -> float:
    """Return the opening, changed by a share on one side or on both."""
    if terms is None:
        return opening_v
    term = terms.valve
    if term.size == 0.0:
        return opening_v
    fills = opening_v > 0.0 and term.location == FILLING_AT
    exhausts = opening_v < 0.0 and term.location == EXHAUSTING_AT
    if fills or exhausts or term.location == OPENING_AT:
        value = age_s if term.driver == TIME else abs(opening_v)
        return opening_v * max(1.0 + term.size * shape_of(term, value, TermMemory(0.0, 0.0)), 0.0)
    return opening_v
