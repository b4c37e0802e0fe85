"""A law as another package brings it: super-twisting, with two numbers of memory."""

from __future__ import annotations

from math import copysign, sqrt
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from pamctl.control.law import (
    UNITS_PER_METRE,
    GainAxis,
    Law,
    LawSettings,
    LawTerms,
    LengthUnit,
    SearchSpace,
    Term,
)
from pamctl.control.sliding import clamp_value
from pamctl.signals import Command, Estimate, Reference


class SuperTwistingSettings(LawSettings):
    """u = -k_1 |s|^(1/2) sign(s) + v, v' = -k_2 sat(s / s_0); every key has a default."""

    law: Literal["super_twisting"]
    length_unit: LengthUnit = "mm"
    lpf2_hz: Annotated[float, Field(gt=0, le=440)] = 400.0
    lambda_per_s: Annotated[float, Field(gt=0, le=1e4)] = 100.0
    k1: Annotated[float, Field(gt=0, description="V per root of length/s")] = 0.25
    k2_v_per_s: Annotated[float, Field(ge=0)] = 2.0


class SuperTwistingGains(NamedTuple):
    """What the kernel takes."""

    units_per_m: float
    lambda_per_s: float
    k1: float
    k2_v_per_s: float
    limit_v: float


class Twist(NamedTuple):
    """The integral v, and the surface of the tick before."""

    twist_v: float
    surface: float


def to_gains(settings: SuperTwistingSettings) -> SuperTwistingGains:
    """Convert the unit once."""
    return SuperTwistingGains(
        UNITS_PER_METRE[settings.length_unit],
        settings.lambda_per_s,
        settings.k1,
        settings.k2_v_per_s,
        settings.command_limit_v,
    )


def half_power(value: float) -> float:
    """Return |value|^(1/2) sign(value): a kernel of this package, called by another one."""
    return copysign(sqrt(abs(value)), value)


def super_twisting(
    gains: SuperTwistingGains, memory: Twist, reference: Reference, estimate: Estimate, dt_s: float
) -> tuple[Command, Twist]:
    """Take one tick. The integral follows the mean of the surface of two ticks."""
    s_m_per_s = estimate.error_rate_m_per_s + gains.lambda_per_s * estimate.error_m
    s = s_m_per_s * gains.units_per_m
    mean = clamp_value(0.5 * (s + memory.surface), 1.0)
    direct_v = -gains.k1 * half_power(s)
    twist_v = clamp_value(memory.twist_v - gains.k2_v_per_s * mean * dt_s, gains.limit_v)
    wanted_v = direct_v + twist_v
    command_v = clamp_value(wanted_v, gains.limit_v)
    return (
        Command(command_v, s_m_per_s, direct_v, twist_v, command_v != wanted_v),
        Twist(twist_v, s),
    )


LAW = Law(
    name="super_twisting",
    title="Super-twisting",
    equation="u = -k_1 |s|^(1/2) sign(s) + v, v' = -k_2 sat(s), s = e' + lambda e",
    settings=SuperTwistingSettings,
    gains=SuperTwistingGains,
    to_gains=to_gains,
    kernel=super_twisting,
    armed=Twist(0.0, 0.0),
    terms=LawTerms(
        surface=Term("sigma", "m/s", "twisting surface"),
        equivalent=Term("u_root", "V"),
        robust=Term("v_twist", "V", "integral of the sign"),
    ),
    blended=frozenset({"lambda_per_s", "k1", "k2_v_per_s"}),
    search=SearchSpace(
        fixed={"law": "super_twisting", "length_unit": "mm", "lambda_per_s": 100.0},
        axes=(GainAxis("k1", 0.1, 1.0, 0.25), GainAxis("k2_v_per_s", 0.1, 50.0, 2.0)),
    ),
)
