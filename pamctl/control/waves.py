"""Shapes of a motion: a value over time with its exact first three derivatives.

The loop asks one shape once in a tick. A shape is a few numbers and a closed form. Its value at a
time does not depend on what was asked before, so it gives the same bits in the loop, beforehand,
and in a replay.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple, Protocol

from pamctl.kernel.calls import machine

MOST_TONES = 40
"""The tick evaluates every tone: some 0.4 us each."""
_MOST_SAMPLES = 8000
_SAMPLES_PER_PERIOD = 16
_REACH = 2
"""Points on either side that the derivatives at a point of a table are taken from."""


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


class Tone(NamedTuple):
    """One sine: amplitude, angular frequency (rad/s) and phase (rad)."""

    amplitude: float
    rad_per_s: float
    phase_rad: float


@dataclass(frozen=True, slots=True)
class Tones:
    """A sum of sines."""

    tones: tuple[Tone, ...]

    def at(self, t_s: float) -> Motion:
        """Return the sum and its derivatives."""
        x = v = a = j = 0.0
        for amplitude, w, phase in self.tones:
            angle = w * t_s + phase
            s = amplitude * math.sin(angle)
            c = amplitude * w * math.cos(angle)
            x += s
            v += c
            a -= w * w * s
            j -= w * w * c
        return Motion(x, v, a, j)

    def sample(self, step_s: float, count: int) -> list[float]:
        """Return the sum alone, at `count` times from 0 on."""
        values = array("d", bytes(8 * count))
        machine(add_tones)(array("d", chain.from_iterable(self.tones)), step_s, values)
        return values.tolist()


def add_tones(tones: Any, step_s: float, values: Any) -> None:
    """Kernel: add to each value the tones at its time; `tones` holds three numbers of each."""
    for k in range(len(values)):
        x, t_s = values[k], k * step_s
        for i in range(len(tones) // 3):
            x += tones[3 * i] * math.sin(tones[3 * i + 1] * t_s + tones[3 * i + 2])
        values[k] = x


@dataclass(frozen=True, slots=True)
class Sweep:
    """A tone whose frequency goes from one value to another, in equal steps of Hz or of octaves."""

    amplitude: float
    start_hz: float
    end_hz: float
    duration_s: float
    is_logarithmic: bool

    def at(self, t_s: float) -> Motion:
        """Return the tone and its derivatives from the derivatives of its phase."""
        if self.is_logarithmic and self.start_hz != self.end_hz:
            growth = math.log(self.end_hz / self.start_hz) / self.duration_s
            w = math.tau * self.start_hz * math.exp(growth * t_s)
            phase = math.tau * self.start_hz * math.expm1(growth * t_s) / growth
            w1 = growth * w
            w2 = growth * w1
        else:
            rate = (self.end_hz - self.start_hz) / self.duration_s
            phase = math.tau * t_s * (self.start_hz + 0.5 * rate * t_s)
            w = math.tau * (self.start_hz + rate * t_s)
            w1 = math.tau * rate
            w2 = 0.0
        s = self.amplitude * math.sin(phase)
        c = self.amplitude * math.cos(phase)
        return Motion(s, c * w, c * w1 - s * w * w, c * (w2 - w * w * w) - 3.0 * s * w * w1)

    def frequency_at(self, t_s: float) -> float:
        """Return the frequency (Hz) at a time."""
        share = t_s / self.duration_s
        if self.is_logarithmic:
            return float(self.start_hz * (self.end_hz / self.start_hz) ** share)
        return self.start_hz + share * (self.end_hz - self.start_hz)


def scale_to_peak(tones: Sequence[Tone], peak: float, duration_s: float) -> Tones:
    """Scale tones so that the highest value within `duration_s` is `peak`.

    The highest value is sought at 16 points of the fastest tone's period, and at 8000 points at
    most: of a long wave it is then the highest value of those points.
    """
    fastest_hz = max(tone.rad_per_s for tone in tones) / math.tau
    samples = min(math.ceil(_SAMPLES_PER_PERIOD * fastest_hz * duration_s) + 1, _MOST_SAMPLES)
    step_s = duration_s / samples
    whole = Tones(tuple(tones))
    highest = max(map(abs, whole.sample(step_s, samples)))
    scale = peak / highest if highest else 1.0
    return Tones(tuple(tone._replace(amplitude=scale * tone.amplitude) for tone in tones))


class Sampled:
    """The curve through the points of a table; times rise, and the first one is 0.

    It goes through every point, with continuous third derivative. At each point the first three
    derivatives are those of the polynomial through it and its two neighbours on either side.
    Between two points runs the polynomial of degree 7 that meets value and derivatives at both.
    Before the first point and after the last the curve is at rest.
    """

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
