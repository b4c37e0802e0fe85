"""PID with a filtered derivative: the sliding mode laws are compared to it."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from pamctl.control.law import (
    UNITS_PER_METRE,
    GainAxis,
    Law,
    LawSettings,
    LawTerms,
    SearchSpace,
    Term,
)
from pamctl.control.sliding import Absement, clamp_value, prevent_windup
from pamctl.signals import Command, Estimate, Reference


class PidSettings(LawSettings):
    """u = -(K_p e + K_I int e + K_D e'), e' through LPF_2; gains in `length_unit`."""

    law: Literal["pid"]
    kp_v_per_length: Annotated[float, Field(ge=0)]
    ki_v_per_length_s: Annotated[float, Field(ge=0)]
    kd_v_s_per_length: Annotated[float, Field(ge=0)]


class PidGains(NamedTuple):
    """Gains in SI for the kernel."""

    kp_v_per_m: float
    ki_v_per_m_s: float
    kd_v_s_per_m: float
    limit_v: float


def pid_gains(settings: PidSettings) -> PidGains:
    """Turn settings into the numbers that the kernel uses."""
    scale = UNITS_PER_METRE[settings.length_unit]
    return PidGains(
        settings.kp_v_per_length * scale,
        settings.ki_v_per_length_s * scale,
        settings.kd_v_s_per_length * scale,
        settings.command_limit_v,
    )


def pid(
    gains: PidGains, memory: Absement, reference: Reference, estimate: Estimate, dt_s: float
) -> tuple[Command, Absement]:
    """Return the command and the terms; the integral is held while it would wind up."""
    absement_m_s = memory.absement_m_s + estimate.error_m * dt_s
    integral_v = -gains.ki_v_per_m_s * absement_m_s
    direct_v = -(
        gains.kp_v_per_m * estimate.error_m + gains.kd_v_s_per_m * estimate.error_rate_m_per_s
    )
    wanted_v = direct_v + integral_v
    command_v = clamp_value(wanted_v, gains.limit_v)
    return (
        Command(command_v, math.nan, direct_v, integral_v, command_v != wanted_v),
        prevent_windup(memory, absement_m_s, estimate.error_m, wanted_v - command_v),
    )


LAW = Law(
    name="pid",
    title="PID",
    equation="u = -(K_p e + K_I int e + K_D e')",
    settings=PidSettings,
    gains=PidGains,
    to_gains=pid_gains,
    kernel=pid,
    armed=Absement(0.0),
    terms=LawTerms(
        surface=None,
        equivalent=Term("proportional and derivative", "V"),
        robust=Term("integral", "V"),
    ),
    # The kernel's gains are in SI: another length_unit only writes the same gains in other
    # numbers, and is no other law.
    blended=frozenset({"length_unit", "kp_v_per_length", "ki_v_per_length_s", "kd_v_s_per_length"}),
    search=SearchSpace(
        fixed={"law": "pid", "length_unit": "mm"},
        axes=(
            GainAxis("kp_v_per_length", 0.3, 100.0, 17.0),
            GainAxis("ki_v_per_length_s", 1e-3, 1e3, 20.0),
            GainAxis("kd_v_s_per_length", 1e-4, 2.0, 0.18),
            GainAxis("lpf1_hz", 40.0, 440.0, 430.0),
            GainAxis("lpf2_hz", 10.0, 440.0, 430.0),
        ),
    ),
)
