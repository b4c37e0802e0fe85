"""What several laws share: the integral of the error, the command limit, the sliding surface.

The search varies the sliding laws' response at rest, not K_p and phi. With the reaching law
saturated the command is

    u = -K_p / g (l^3 + 3 eta l^2) e - ...,    l = lambda^q, g = 1 in Eq. 17, g-hat in Eq. 18.

Gains with nearly the same effect can therefore differ by decades in K_p if lambda or eta differ.
The search uses the factor of e instead, in V/mm. K_P is that factor of a PID, so all shipped laws
have the same bounds of it. Instead of phi the search uses the error, in mm, at which the term
3 l^2 e of s alone reaches phi. Only lambda^q enters the laws, so q keeps its value in the paper.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field

from pamctl.control.law import UNITS_PER_METRE, GainAxis, LawSettings, LawTerms, Term


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


class SlidingGains(NamedTuple):
    """Gains of the sliding surface for the kernels."""

    units_per_m: float
    pole_per_s: float
    """lambda^q: the error poles of the surface."""
    eta: float
    phi: float
    literal_reaching: bool
    limit_v: float


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


SLIDING_BLENDED = frozenset({"lambda_per_s", "q", "eta", "phi"})
"""Not `length_unit` and `reaching_law`: between two of those there is no law."""
SLIDING_TERMS = LawTerms(
    surface=Term("s", "m/s²", "sliding surface of Eq. 11"),
    equivalent=Term("u_eq", "V", "equivalent control"),
    robust=Term("u_rb", "V", "robust term of Eq. 15"),
)

# --- the search of gains ----------------------------------------------------------------

Numbers = dict[str, float]

FIXED_SLIDING: dict[str, Any] = {"length_unit": "mm", "reaching_law": "eta_abs_s"}
STIFFNESS_BOUNDS = (0.3, 100.0)
LPF1_BOUNDS = (40.0, 440.0)
LPF2_BOUNDS = (10.0, 440.0)
REACHING_AXES = (GainAxis("eta", 1e-3, 1e3, 2.0), GainAxis("boundary_mm", 1e-5, 10.0, 1e-4))


def sliding_gains_at(
    numbers: Numbers, q: float, kp_name: str, gain_mm_per_s3_v: float
) -> dict[str, Any]:
    """Return the keys of a gains file for numbers of the search; `gain_mm_per_s3_v` is g."""
    kp = numbers["stiffness_v_per_mm"] * gain_mm_per_s3_v / _stiffness_per_s3(numbers, q)
    return {
        "lambda_per_s": numbers["lambda_per_s"],
        kp_name: kp,
        "eta": numbers["eta"],
        "phi": numbers["boundary_mm"] * _phi_per_mm(numbers, q),
        "lpf1_hz": numbers["lpf1_hz"],
        "lpf2_hz": numbers["lpf2_hz"],
    }


def sliding_numbers_of(gains: Numbers, q: float, kp_name: str, gain_mm_per_s3_v: float) -> Numbers:
    """Undo `sliding_gains_at`."""
    return {
        **gains,
        "stiffness_v_per_mm": gains[kp_name] * _stiffness_per_s3(gains, q) / gain_mm_per_s3_v,
        "boundary_mm": gains["phi"] / _phi_per_mm(gains, q),
    }


def _stiffness_per_s3(numbers: Numbers, q: float) -> float:
    """Factor of e in the sliding laws, over K_p / g."""
    pole: float = numbers["lambda_per_s"] ** q
    return pole**2 * (pole + 3.0 * numbers["eta"])


def _phi_per_mm(numbers: Numbers, q: float) -> float:
    pole: float = numbers["lambda_per_s"] ** q
    return 3.0 * pole**2
