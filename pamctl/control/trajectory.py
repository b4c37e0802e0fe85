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

    This is the polynomial of lowest order with zero velocity, acceleration and jerk at both ends:
    35 r^4 - 84 r^5 + 70 r^6 - 20 r^7, r = t / duration. The derivatives are exact. Before and
    after the motion the position is constant.
    """
    if t_s <= 0.0:
        return Motion(start_m, 0.0, 0.0, 0.0)
    if t_s >= duration_s:
        return Motion(end_m, 0.0, 0.0, 0.0)
    r = t_s / duration_s
    rest = 1.0 - r
    bow = r * rest
    rate = (end_m - start_m) / duration_s
    shape = r * r * r * r * (35.0 + r * (-84.0 + r * (70.0 - 20.0 * r)))
    return Motion(
        start_m + (end_m - start_m) * shape,
        140.0 * rate * bow * bow * bow,
        420.0 * rate / duration_s * bow * bow * (1.0 - 2.0 * r),
        840.0 * rate / (duration_s * duration_s) * bow * (1.0 - 5.0 * bow),
    )
