"""How the gains of the two sliding mode laws are sought.

They are sought by what they do at rest, not by K_p and phi. With the reaching law saturated the
command is

    u = -K_p / g (l^3 + 3 eta l^2) e - ...,    l = lambda^q, g = 1 in Eq. 17, g-hat in Eq. 18.

Gains that do nearly the same therefore lie decades apart in K_p when lambda or eta differ. The
search takes the factor of e instead, in V/mm. K_P is that factor of a PID: all shipped laws are
sought between the same bounds of it. Instead of phi the search takes the error, in mm, at which
the term 3 l^2 e of s alone reaches phi.

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
    sought: Numbers, q: float, kp_name: str, gain_mm_per_s3_v: float
) -> dict[str, Any]:
    """Return the keys of a gains file for sought numbers; `gain_mm_per_s3_v` is g."""
    kp = sought["stiffness_v_per_mm"] * gain_mm_per_s3_v / _stiffness_per_s3(sought, q)
    return {
        "lambda_per_s": sought["lambda_per_s"],
        kp_name: kp,
        "eta": sought["eta"],
        "phi": sought["boundary_mm"] * _phi_per_mm(sought, q),
        "lpf1_hz": sought["lpf1_hz"],
        "lpf2_hz": sought["lpf2_hz"],
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
