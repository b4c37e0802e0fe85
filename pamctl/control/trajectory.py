"""Motion from rest to rest: the 7th-order polynomial of Sec. VI-B."""

from __future__ import annotations

from typing import NamedTuple


class Motion(NamedTuple):
    """Position and its three derivatives, in m and s."""

    position_m: float
    velocity_m_per_s: float
    acceleration_m_per_s2: float
    jerk_m_per_s3: float


def rest_to_rest(start_m: float, end_m: float, duration_s: float, t_s: float) -> Motion:
    """Move from rest to rest within `duration_s`.

    Of the polynomials that leave and arrive with zero velocity, acceleration and jerk it
    is the shortest: 35 r^4 - 84 r^5 + 70 r^6 - 20 r^7, r = t / duration. The derivatives
    are exact. Before and after the motion it stands still.
    """
    if t_s <= 0.0:
        return Motion(start_m, 0.0, 0.0, 0.0)
    if t_s >= duration_s:
        return Motion(end_m, 0.0, 0.0, 0.0)
    r = t_s / duration_s
    rest = 1.0 - r
    span = end_m - start_m
    shape = r**4 * (35.0 + r * (-84.0 + r * (70.0 - 20.0 * r)))
    return Motion(
        start_m + span * shape,
        span / duration_s * 140.0 * r**3 * rest**3,
        span / duration_s**2 * 420.0 * r**2 * rest**2 * (1.0 - 2.0 * r),
        span / duration_s**3 * 840.0 * r * rest * (1.0 - 5.0 * r * rest),
    )
