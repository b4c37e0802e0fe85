"""A table of points as a smooth curve: through every point, with continuous third derivative.

At each point the first three derivatives are those of the polynomial through it and its two
neighbours on either side. Between two points runs the polynomial of degree 7 that meets value and
derivatives at both. Before the first point and after the last the curve is at rest.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

from pamctl.control.trajectory import Motion

_REACH = 2


class Sampled:
    """The curve through the points of a table; times rise, and the first one is 0."""

    __slots__ = ("_at", "_coefficients", "_points", "_t_s")

    def __init__(self, t_s: Sequence[float], values: Sequence[float]) -> None:
        """Take two or more points. Each interval is worked out when the time first comes to it."""
        first_s, last_s = t_s[1] - t_s[0], t_s[-1] - t_s[-2]
        before = [(t_s[0] - i * first_s, values[0]) for i in range(_REACH, 0, -1)]
        after = [(t_s[-1] + i * last_s, values[-1]) for i in range(1, _REACH + 1)]
        self._t_s = tuple(t_s)
        self._points = (*before, *zip(t_s, values, strict=True), *after)
        self._at = -1
        self._coefficients: tuple[float, ...] = ()

    def at(self, t_s: float) -> Motion:
        """Return the curve at `t_s`."""
        times_s = self._t_s
        interval = min(max(bisect_right(times_s, t_s) - 1, 0), len(times_s) - 2)
        if interval != self._at:
            self._coefficients = self._fit_interval(interval)
            self._at = interval
        width_s = times_s[interval + 1] - times_s[interval]
        r = min(max((t_s - times_s[interval]) / width_s, 0.0), 1.0)
        c0, c1, c2, c3, c4, c5, c6, c7 = self._coefficients
        return Motion(
            c0 + r * (c1 + r * (c2 + r * (c3 + r * (c4 + r * (c5 + r * (c6 + r * c7)))))),
            (
                c1
                + r
                * (2 * c2 + r * (3 * c3 + r * (4 * c4 + r * (5 * c5 + r * (6 * c6 + r * 7 * c7)))))
            )
            / width_s,
            (2 * c2 + r * (6 * c3 + r * (12 * c4 + r * (20 * c5 + r * (30 * c6 + r * 42 * c7)))))
            / width_s**2,
            (6 * c3 + r * (24 * c4 + r * (60 * c5 + r * (120 * c6 + r * 210 * c7)))) / width_s**3,
        )

    def _fit_interval(self, interval: int) -> tuple[float, ...]:
        """Return the coefficients of an interval, in powers of its share r = 0..1."""
        width_s = self._t_s[interval + 1] - self._t_s[interval]
        x0, v0, a0, j0 = self._derive(interval)
        x1, v1, a1, j1 = self._derive(interval + 1)
        c1, c2, c3 = v0 * width_s, a0 * width_s**2 / 2, j0 * width_s**3 / 6
        # What is left to reach at r = 1 by the powers 4 to 7.
        x = x1 - x0 - c1 - c2 - c3
        v = v1 * width_s - c1 - 2 * c2 - 3 * c3
        a = a1 * width_s**2 - 2 * c2 - 6 * c3
        j = j1 * width_s**3 - 6 * c3
        return (
            x0, c1, c2, c3,
            35 * x - 15 * v + 2.5 * a - j / 6,
            -84 * x + 39 * v - 7 * a + j / 2,
            70 * x - 34 * v + 6.5 * a - j / 2,
            -20 * x + 10 * v - 2 * a + j / 6,
        )  # fmt: skip

    def _derive(self, knot: int) -> Motion:
        """Return value and derivatives at a point of the table."""
        middle_s, value = self._points[knot + _REACH]
        if knot in (0, len(self._t_s) - 1):
            return Motion(value, 0.0, 0.0, 0.0)
        around = self._points[knot : knot + 2 * _REACH + 1]
        # Newton's divided differences, then the polynomial's derivatives at the middle.
        times_s = [t_s - middle_s for t_s, _ in around]
        column = [x for _, x in around]
        taylor, basis = [0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
        for order in range(len(around)):
            difference = column[0]
            taylor = [t + difference * b for t, b in zip(taylor, basis, strict=True)]
            # basis times (t - times_s[order])
            basis = [
                (basis[i - 1] if i else 0.0) - times_s[order] * basis[i] for i in range(len(basis))
            ]
            column = [
                (column[i + 1] - column[i]) / (times_s[i + order + 1] - times_s[i])
                for i in range(len(column) - 1)
            ]
        return Motion(value, taylor[1], 2.0 * taylor[2], 6.0 * taylor[3])
