"""What several laws share: the integral of the error, the command limit, the reaching law."""

from __future__ import annotations

from typing import NamedTuple


class Absement(NamedTuple):
    """The memory of a law with one integrator: the integral of e, in the paper the absement."""

    absement_m_s: float


def clamp_value(value: float, limit: float) -> float:
    """Limit a value on either side of 0; with limit 1 the sat() of Eq. 15."""
    # Comparisons, not min and max: each of those costs the tick a tenth of a microsecond.
    if value > limit:
        return limit
    return -limit if value < -limit else value


def prevent_windup(
    memory: Absement, absement_m_s: float, error_m: float, excess_v: float
) -> Absement:
    """Choose the integral to keep.

    `excess_v` is what the limit cut off the command. While it cuts, an error of the sign that
    caused it would only wind the integral up: the integral is held.
    """
    if excess_v * error_m < 0.0:
        return memory
    return Absement(absement_m_s)


def reaching_term(literal: bool, eta: float, phi: float, s: float) -> float:
    """u_rb of Eq. 15: eta |s| sat(s / phi), or eta sat(s / phi) where not `literal`.

    The unit mm/s^3 that Table III gives eta suggests the second; with it the term stays
    below 3 mV. The first is what the paper prints, and the default.
    """
    gain = eta * abs(s) if literal else eta
    return gain * clamp_value(s / phi, 1.0)
