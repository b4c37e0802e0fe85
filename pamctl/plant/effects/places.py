"""The places where effects enter the plant, from the command to the readings of the sensors.

A kernel names the arguments that it needs, out of those that its place gives. The kernels of a
place run one after the other. If the place replaces a value (`replaces`), each kernel takes the
result of the one before; otherwise the results are added up. Units are in the names; pressures are
absolute, except `gauge_pa`; `age_s` is the time since the plant's start.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp
from typing import Literal, NamedTuple

Part = Literal["numbers", "timing", "valve", "air", "mechanics", "sensors"]
"""Parts of the plant. A part without an active effect runs the paper's equations alone."""


class FrictionBand(NamedTuple):
    """Dry friction: `upper_n` when moving up, `lower_n` when moving down, between them at rest."""

    lower_n: float
    upper_n: float


@dataclass(frozen=True)
class Place:
    """One place: what it gives a kernel, and how the result is used."""

    part: Part
    result: str
    """What a kernel returns."""
    gives: tuple[str, ...]
    """Arguments that a kernel may name; a kernel with a memory may also name `memory`."""
    follows: tuple[str, ...] = ()
    """Arguments that the kernel of a memory may name; empty if no effect may have a memory here."""
    replaces: str = ""
    """The argument whose value the result replaces; empty where results are added up."""


_MUSCLE = ("position_m", "velocity_m_per_s", "gauge_pa", "age_s")
_MOTION = ("memory", "begin_m", "end_m", "gauge_pa", "step_s")
"""The muscle moves at constant speed from `begin_m` to `end_m`."""
_HELD = ("memory", "begin", "end", "step_s")
"""The value changes linearly from `begin` to `end`; a command is constant in a step."""

PLACES: dict[str, Place] = {
    "numbers": Place("numbers", "the plant's numbers (PaperParameters)", ("numbers",), (),
                     "numbers"),
    "command": Place("valve", "command to the spool, V", ("command_v", "age_s"), _HELD,
                     "command_v"),
    "opening": Place("valve",
                     "opening, in volts of the command that opens the paper's valve as far",
                     ("opening_v", "age_s"), _HELD, "opening_v"),
    "flow": Place("air", "added mass flow into the muscle, kg/s",
                  ("opening_v", "pressure_pa", "position_m", "age_s")),
    "volume": Place("air", "volume of the air, m^3", ("volume_m3", "position_m", "pressure_pa"),
                    (), "volume_m3"),
    "pulling_pressure": Place("mechanics", "gauge pressure that pulls, Pa",
                              ("pulling_pa", *_MUSCLE), (), "pulling_pa"),
    "force": Place("mechanics", "added pull, N; in the direction of contraction", _MUSCLE, _MOTION),
    "friction": Place("mechanics", "dry friction (FrictionBand)", ("band", *_MUSCLE), _MOTION,
                      "band"),
    "damping": Place("mechanics", "added damping, N s/m", _MUSCLE, _MOTION),
    "pressure_reading": Place("sensors", "absolute pressure that the sensor shows, Pa",
                              ("pressure_pa", "atmosphere_pa", "age_s"), _HELD, "pressure_pa"),
    "position_reading": Place("sensors", "displacement that the encoder shows, m",
                              ("position_m", "age_s"), _HELD, "position_m"),
}  # fmt: skip
"""In the order of a step."""


# Kernels that several effects share.


def follow_with_play(before: float, target: float, width: float) -> float:
    """Follow a target with a total slack of `width`, moving only when pushed; one unit for all."""
    half = 0.5 * width
    return min(max(before, target - half), target + half)


def lag_weights(time_s: float, step_s: float) -> tuple[float, float]:
    """Return the weights of a lag over a step: of its last value, and of a ramp of its input.

    y(h) = kept y(0) + (1 - kept) r(0) + weight (r(h) - r(0)) is exact for a linear r.
    """
    if time_s <= 0.0:
        return 0.0, 1.0
    kept = exp(-step_s / time_s)
    return kept, 1.0 - (1.0 - kept) * time_s / step_s
