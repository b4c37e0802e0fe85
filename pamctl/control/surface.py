"""What all laws share: the state they keep, and how they meet the command limit."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from hal.configured import Configured

LengthUnit = Literal["mm", "inch"]
UNITS_PER_METRE: dict[str, float] = {"mm": 1000.0, "inch": 1.0 / 25.4e-3}

Cutoff = Annotated[float, Field(gt=0, le=1000)]


class LawSettings(Configured):
    """What every law is told.

    `length_unit` is the unit of e, and so of every gain: Eq. 15 is not homogeneous, so
    with other units the same numbers are another law.
    """

    length_unit: LengthUnit
    lpf1_hz: Annotated[Cutoff, Field(description="LPF_1, on the displacement")] = 300.0
    lpf2_hz: Annotated[Cutoff, Field(description="LPF_2, on the derivatives of the error")]
    command_limit_v: Annotated[
        float, Field(gt=0, le=10, description="the law's own limit of u, either side of 0")
    ] = 5.0


class LawState(NamedTuple):
    """What a law remembers: the integral of e, which the paper calls absement."""

    absement_m_s: float


ARMED = LawState(0.0)
"""A law that starts from the measured position, its integral cleared."""


def clamp_value(value: float, limit: float) -> float:
    """Limit a value on either side of 0; with limit 1 the sat() of Eq. 15."""
    # Comparisons, not min and max: each of those costs the tick a tenth of a microsecond.
    if value > limit:
        return limit
    return -limit if value < -limit else value


def prevent_windup(
    state: LawState, absement_m_s: float, error_m: float, excess_v: float
) -> LawState:
    """Choose the integral to keep.

    While the command is cut (`excess_v` is what was cut off) an error of the sign that
    caused it would only wind the integral up: it is held.
    """
    if excess_v * error_m < 0.0:
        return state
    return LawState(absement_m_s)


def reaching_term(literal: bool, eta: float, phi: float, s: float) -> float:
    """u_rb of Eq. 15: eta |s| sat(s / phi), or eta sat(s / phi) where not `literal`.

    The unit mm/s^3 that Table III gives eta suggests the second; with it the term stays
    below 3 mV. The first is what the paper prints, and the default.
    """
    gain = eta * abs(s) if literal else eta
    return gain * clamp_value(s / phi, 1.0)
