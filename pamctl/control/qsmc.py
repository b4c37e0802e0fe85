"""qSMC: the sliding mode law of Eq. 17, which needs no model of the muscle."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field

from pamctl.control.law import (
    UNITS_PER_METRE,
    GainAxis,
    Law,
    LawSettings,
    LawTerms,
    SearchSpace,
    Term,
    read_numbers,
)
from pamctl.control.sliding_search import (
    FIXED_SLIDING,
    LPF1_BOUNDS,
    LPF2_BOUNDS,
    REACHING_AXES,
    STIFFNESS_BOUNDS,
    sliding_gains_at,
    sliding_numbers_of,
)
from pamctl.control.surface import Absement, clamp_value, prevent_windup, reaching_term
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


SLIDING_BLENDED = frozenset({"lambda_per_s", "q", "eta", "phi"})
"""Not `length_unit` and `reaching_law`: between two of those there is no law."""
SLIDING_TERMS = LawTerms(
    surface=Term("s", "m/s²", "sliding surface of Eq. 11"),
    equivalent=Term("u_eq", "V", "equivalent control"),
    robust=Term("u_rb", "V", "robust term of Eq. 15"),
)

_SEARCH_TERMS = (1.75, "kp_v_s3_per_length", 1.0)


def _to_gains(numbers: dict[str, float]) -> dict[str, Any]:
    return sliding_gains_at(numbers, *_SEARCH_TERMS)


def _from_gains(gains: dict[str, Any]) -> dict[str, float]:
    return sliding_numbers_of(read_numbers(gains), *_SEARCH_TERMS)


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
        to_gains=_to_gains,
        from_gains=_from_gains,
    ),
)
