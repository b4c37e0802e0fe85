"""PID with a filtered derivative: what the sliding mode laws are compared to."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from pamctl.control.surface import (
    UNITS_PER_METRE,
    LawSettings,
    LawState,
    clamp_value,
    prevent_windup,
)
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
    gains: PidGains, state: LawState, reference: Reference, estimate: Estimate, dt_s: float
) -> tuple[Command, LawState]:
    """Return the command and the terms; the integral is held while it would wind up."""
    absement_m_s = state.absement_m_s + estimate.error_m * dt_s
    integral_v = -gains.ki_v_per_m_s * absement_m_s
    direct_v = -(
        gains.kp_v_per_m * estimate.error_m + gains.kd_v_s_per_m * estimate.error_rate_m_per_s
    )
    wanted_v = direct_v + integral_v
    command_v = clamp_value(wanted_v, gains.limit_v)
    return (
        Command(command_v, math.nan, direct_v, integral_v, command_v != wanted_v),
        prevent_windup(state, absement_m_s, estimate.error_m, wanted_v - command_v),
    )
