"""qSMC: the sliding mode law of Eq. 17, which needs no model of the muscle."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from pamctl.control.law import GainAxis, Law, SearchSpace, read_numbers
from pamctl.control.sliding import (
    FIXED_SLIDING,
    LPF1_BOUNDS,
    LPF2_BOUNDS,
    REACHING_AXES,
    SLIDING_BLENDED,
    SLIDING_TERMS,
    STIFFNESS_BOUNDS,
    Absement,
    SlidingGains,
    SlidingSettings,
    clamp_value,
    prevent_windup,
    reaching_term,
    sliding_gains,
    sliding_gains_at,
    sliding_numbers_of,
)
from pamctl.signals import Command, Estimate, Reference


class QsmcSettings(SlidingSettings):
    """Eq. 17."""

    law: Literal["qsmc"]
    kp_v_s3_per_length: Annotated[float, Field(gt=0, description="K_p of Eq. 17")]


class QsmcGains(NamedTuple):
    """Gains of Eq. 17 for the kernel."""

    sliding: SlidingGains
    kp_v_s3_per_length: float


def qsmc_gains(settings: QsmcSettings) -> QsmcGains:
    """Turn settings into the numbers that the kernel uses."""
    return QsmcGains(sliding_gains(settings), settings.kp_v_s3_per_length)


def qsmc(
    gains: QsmcGains, memory: Absement, reference: Reference, estimate: Estimate, dt_s: float
) -> tuple[Command, Absement]:
    """u = K_p (x_D''' - 3 l e'' - 3 l^2 e' - l^3 e - u_rb), l = lambda^q (Eq. 17)."""
    g = gains.sliding
    scale, pole = g.units_per_m, g.pole_per_s
    e = estimate.error_m * scale
    rate = estimate.error_rate_m_per_s * scale
    acceleration = estimate.error_acceleration_m_per_s2 * scale
    absement_m_s = memory.absement_m_s + estimate.error_m * dt_s

    # s of Eq. 11, and the part of its derivative (Eq. 12) that e''' does not carry.
    s = acceleration + pole * (3.0 * rate + pole * (3.0 * e + pole * scale * absement_m_s))
    drift = pole * (3.0 * acceleration + pole * (3.0 * rate + pole * e))
    equivalent_v = gains.kp_v_s3_per_length * (reference.reference_jerk_m_per_s3 * scale - drift)
    robust_v = -gains.kp_v_s3_per_length * reaching_term(g.literal_reaching, g.eta, g.phi, s)

    wanted_v = equivalent_v + robust_v
    command_v = clamp_value(wanted_v, g.limit_v)
    return (
        Command(command_v, s / scale, equivalent_v, robust_v, command_v != wanted_v),
        prevent_windup(memory, absement_m_s, estimate.error_m, wanted_v - command_v),
    )


_SEARCH_TERMS = (1.75, "kp_v_s3_per_length", 1.0)


LAW = Law(
    name="qsmc",
    title="qSMC",
    equation="u = K_p (x_D''' - 3 l e'' - 3 l^2 e' - l^3 e - u_rb), l = lambda^q (Eq. 17)",
    settings=QsmcSettings,
    gains=QsmcGains,
    to_gains=qsmc_gains,
    kernel=qsmc,
    armed=Absement(0.0),
    terms=SLIDING_TERMS,
    blended=SLIDING_BLENDED | {"kp_v_s3_per_length"},
    search=SearchSpace(
        fixed={"law": "qsmc", **FIXED_SLIDING, "q": _SEARCH_TERMS[0]},
        axes=(
            GainAxis("lambda_per_s", 5.0, 80.0, 30.0),
            GainAxis("stiffness_v_per_mm", *STIFFNESS_BOUNDS, 25.0),
            *REACHING_AXES,
            GainAxis("lpf1_hz", *LPF1_BOUNDS, 200.0),
            GainAxis("lpf2_hz", *LPF2_BOUNDS, 430.0),
        ),
        to_gains=lambda numbers: sliding_gains_at(numbers, *_SEARCH_TERMS),
        from_gains=lambda gains: sliding_numbers_of(read_numbers(gains), *_SEARCH_TERMS),
    ),
)
