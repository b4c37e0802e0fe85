"""Waves about zero: sums of tones, and a tone of changing frequency."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pamctl.control.trajectory import Motion

MOST_TONES = 40
"""The tick evaluates every tone: some 0.4 us each."""
_MOST_SAMPLES = 8000
_SAMPLES_PER_PERIOD = 16


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
    highest = max(abs(_sum_at(tones, i * step_s)) for i in range(samples))
    scale = peak / highest if highest else 1.0
    return Tones(tuple(tone._replace(amplitude=scale * tone.amplitude) for tone in tones))


def _sum_at(tones: Iterable[Tone], t_s: float) -> float:
    return sum(amplitude * math.sin(w * t_s + phase) for amplitude, w, phase in tones)
