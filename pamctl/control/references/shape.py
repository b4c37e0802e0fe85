"""Shapes: a value over time with its exact first three derivatives.

The loop asks one shape once in a tick. A shape is a few numbers and a closed form. Its value at a
time does not depend on what was asked before, so it gives the same bits in the loop, beforehand,
and in a replay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from pamctl.control.trajectory import Motion, rest_to_rest


class Shape(Protocol):
    """A value over time, in m for the muscle and in V for the valve."""

    def at(self, t_s: float) -> Motion:
        """Return the value and its derivatives `t_s` after the shape's own beginning."""


@dataclass(frozen=True, slots=True)
class Transition:
    """From rest to rest, as the motions of the paper's experiments."""

    start: float
    end: float
    duration_s: float

    def at(self, t_s: float) -> Motion:
        """Return the polynomial of `rest_to_rest`."""
        return rest_to_rest(self.start, self.end, self.duration_s, t_s)


@dataclass(frozen=True, slots=True)
class SpeedChange:
    """From one constant speed to another, with continuous jerk at both ends.

    The speed follows 10 r^3 - 15 r^4 + 6 r^5, r = t / duration. With two equal speeds it is a
    straight line.
    """

    start: float
    start_per_s: float
    end_per_s: float
    duration_s: float

    def at(self, t_s: float) -> Motion:
        """Return the polynomial of degree 6."""
        lasts_s = self.duration_s
        r = t_s / lasts_s
        change = self.end_per_s - self.start_per_s
        rest = 1.0 - r
        return Motion(
            self.start
            + self.start_per_s * t_s
            + change * lasts_s * (r * r * r * r * (2.5 + r * (r - 3.0))),
            self.start_per_s + change * (r * r * r * (10.0 + r * (6.0 * r - 15.0))),
            change / lasts_s * (30.0 * r * r * rest * rest),
            change / (lasts_s * lasts_s) * (60.0 * r * rest * (1.0 - 2.0 * r)),
        )


@dataclass(frozen=True, slots=True)
class Faded:
    """A part of a wave about an offset; the wave grows or decays smoothly within the part."""

    wave: Shape
    offset: float
    from_s: float
    """Time in the wave at which the part begins."""
    begin_share: float
    end_share: float
    """Share of the wave at the end of the part: 0 or 1, as `begin_share`."""
    duration_s: float

    def at(self, t_s: float) -> Motion:
        """Return the wave times its envelope, by the product rule."""
        x, v, a, j = self.wave.at(self.from_s + t_s)
        if self.begin_share == self.end_share:
            return Motion(self.offset + x, v, a, j)
        e, e1, e2, e3 = rest_to_rest(self.begin_share, self.end_share, self.duration_s, t_s)
        return Motion(
            self.offset + e * x,
            e1 * x + e * v,
            e2 * x + 2.0 * e1 * v + e * a,
            e3 * x + 3.0 * (e2 * v + e1 * a) + e * j,
        )
