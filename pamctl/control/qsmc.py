"""qSMC: the sliding mode law of Eq. 17, which needs no model of the muscle."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from pamctl.control.surface import (
    UNITS_PER_METRE,
    LawSettings,
    LawState,
    clamp_value,
    prevent_windup,
    reaching_term,
)
from pamctl.signals import Command, Estimate, Reference


class SlidingSettings(LawSettings):
    """Gains of Eq. 10 to 18, in `length_unit`."""

    lambda_per_s: Annotated[
        float, Field(gt=0, le=1e4, description="the printed number, without 2 pi")
    ]
    q: Annotated[float, Field(gt=0, le=5, description="exponent of lambda, Eq. 10")]
    eta: Annotated[float, Field(ge=0, description="gain of the robust term, Eq. 15")]
    phi: Annotated[float, Field(gt=0, description="boundary layer of s, length/s^2")]
    reaching_law: Annotated[
        Literal["eta_abs_s", "eta"],
        Field(description="Eq. 15 as printed, eta |s| sat(s/phi), or eta sat(s/phi)"),
    ] = "eta_abs_s"


class QsmcSettings(SlidingSettings):
    """Eq. 17."""

    law: Literal["qsmc"]
    kp_v_s3_per_length: Annotated[float, Field(gt=0, description="K_p of Eq. 17")]


class SlidingGains(NamedTuple):
    """Gains of the sliding surface for the kernels."""

    units_per_m: float
    pole_per_s: float
    """lambda^q: the error poles of the surface."""
    eta: float
    phi: float
    literal_reaching: bool
    limit_v: float


class QsmcGains(NamedTuple):
    """Gains of Eq. 17 for the kernel."""

    sliding: SlidingGains
    kp_v_s3_per_length: float


def sliding_gains(settings: SlidingSettings) -> SlidingGains:
    """Turn settings into the numbers that the kernels use."""
    return SlidingGains(
        units_per_m=UNITS_PER_METRE[settings.length_unit],
        pole_per_s=settings.lambda_per_s**settings.q,
        eta=settings.eta,
        phi=settings.phi,
        literal_reaching=settings.reaching_law == "eta_abs_s",
        limit_v=settings.command_limit_v,
    )


def qsmc_gains(settings: QsmcSettings) -> QsmcGains:
    """Turn settings into the numbers that the kernel uses."""
    return QsmcGains(sliding_gains(settings), settings.kp_v_s3_per_length)


def qsmc(
    gains: QsmcGains, state: LawState, reference: Reference, estimate: Estimate, dt_s: float
) -> tuple[Command, LawState]:
    """u = K_p (x_D''' - 3 l e'' - 3 l^2 e' - l^3 e - u_rb), l = lambda^q (Eq. 17)."""
    g = gains.sliding
    scale, pole = g.units_per_m, g.pole_per_s
    e = estimate.error_m * scale
    rate = estimate.error_rate_m_per_s * scale
    acceleration = estimate.error_acceleration_m_per_s2 * scale
    absement_m_s = state.absement_m_s + estimate.error_m * dt_s

    # s of Eq. 11, and the part of its derivative (Eq. 12) that e''' does not carry.
    s = acceleration + pole * (3.0 * rate + pole * (3.0 * e + pole * scale * absement_m_s))
    drift = pole * (3.0 * acceleration + pole * (3.0 * rate + pole * e))
    equivalent_v = gains.kp_v_s3_per_length * (reference.reference_jerk_m_per_s3 * scale - drift)
    robust_v = -gains.kp_v_s3_per_length * reaching_term(g.literal_reaching, g.eta, g.phi, s)

    wanted_v = equivalent_v + robust_v
    command_v = clamp_value(wanted_v, g.limit_v)
    return (
        Command(command_v, s / scale, equivalent_v, robust_v, command_v != wanted_v),
        prevent_windup(state, absement_m_s, estimate.error_m, wanted_v - command_v),
    )
