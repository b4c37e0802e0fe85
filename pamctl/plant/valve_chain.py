"""From the command to the valve's opening; in the paper both are equal."""

from __future__ import annotations

from typing import Any

from pamctl.plant.chains import follow_command, follow_opening, pass_command, pass_opening
from pamctl.plant.effects.valve.valve_spool import spool_step
from pamctl.plant.parameters import ValveState
from pamctl.plant.terms.operators import Terms
from pamctl.plant.terms.valve_terms import (
    follow_command_term,
    pass_command_term,
    pass_opening_term,
)

LONG_S = 10.0
"""A valve has settled after this time."""


def settle_valve(e: Any, terms: Terms | None, valve: ValveState, command_v: float) -> ValveState:
    """Return the valve's state after it has had a command (V) for long."""
    memory = follow_command(e, valve.memory, command_v, command_v, LONG_S, 0.0)
    spool_v = pass_command(e, memory, command_v, 0.0)
    term = follow_command_term(terms, valve.term, spool_v, LONG_S)
    spool_v = pass_command_term(terms, term, spool_v, 0.0)
    memory = follow_opening(e, memory, spool_v, spool_v, LONG_S, 0.0)
    return ValveState(spool_v, 0.0, memory, term)


def valve_step(
    e: Any, terms: Terms | None, valve: ValveState, command_v: float, age_s: float, step_s: float
) -> tuple[float, ValveState]:
    """Return the opening in the middle of the step, and the valve's state at its end.

    `e` are the `ValveEffects`. The opening is that of the paper's valve with the same area, in
    volts of command.
    """
    half_s = 0.5 * step_s
    middle_age_s = age_s + half_s
    memory = follow_command(e, valve.memory, command_v, command_v, half_s, middle_age_s)
    pushed_v = pass_command(e, memory, command_v, middle_age_s)
    memory = follow_command(e, memory, command_v, command_v, half_s, middle_age_s)
    term = follow_command_term(terms, valve.term, pushed_v, half_s)
    asked_v, pushed_v = pushed_v, pass_command_term(terms, term, pushed_v, middle_age_s)
    term = follow_command_term(terms, term, asked_v, half_s)
    middle_v, rate = spool_step(
        e.valve_spool, valve.spool_v, valve.spool_rate_v_per_s, pushed_v, half_s
    )
    spool_v, spool_rate = spool_step(e.valve_spool, middle_v, rate, pushed_v, half_s)
    memory = follow_opening(e, memory, middle_v, middle_v, half_s, middle_age_s)
    opening_v = pass_opening(e, memory, middle_v, middle_age_s)
    opening_v = pass_opening_term(terms, opening_v, middle_age_s)
    memory = follow_opening(e, memory, middle_v, middle_v, half_s, middle_age_s)
    return opening_v, ValveState(spool_v, spool_rate, memory, term)
