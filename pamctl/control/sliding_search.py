"""The search space of the two sliding mode laws.

The search varies the laws' response at rest, not K_p and phi. With the reaching law saturated the
command is

    u = -K_p / g (l^3 + 3 eta l^2) e - ...,    l = lambda^q, g = 1 in Eq. 17, g-hat in Eq. 18.

Gains with nearly the same effect can therefore differ by decades in K_p if lambda or eta differ.
The search uses the factor of e instead, in V/mm. K_P is that factor of a PID, so all shipped laws
have the same bounds of it. Instead of phi the search uses the error, in mm, at which the term
3 l^2 e of s alone reaches phi.

Only lambda^q enters the laws, so q keeps its value in the paper.
"""

from __future__ import annotations

from typing import Any

from pamctl.control.law import GainAxis

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
