"""The places where effects enter the plant, from the command to the readings of the sensors.

A kernel names the arguments that it wants of those that its place gives. Kernels of a place
run one after the other. Where a value passes (`replaces`), each takes what the one before
it returned; else what they return is added up. Units are in the names; pressures are absolute,
but for `gauge_pa`; `age_s` counts from the plant's first moment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

Part = Literal["numbers", "timing", "valve", "air", "mechanics", "sensors"]
"""Parts of the plant. A part of a step runs the paper's equations alone where no effect acts."""


class FrictionBand(NamedTuple):
    """Dry friction: moving up it is `upper_n`, moving down `lower_n`, at rest anything between."""

    lower_n: float
    upper_n: float


@dataclass(frozen=True)
class Place:
    """One place: what it gives a kernel, and what becomes of the result."""

    part: Part
    result: str
    """What a kernel returns."""
    gives: tuple[str, ...]
    """Arguments that a kernel may name; a kernel with a memory may name `memory`, too."""
    follows: tuple[str, ...] = ()
    """Arguments that the kernel of a memory may name; empty where no effect may remember."""
    replaces: str = ""
    """The argument whose value the result replaces; empty where results are added up."""


_MUSCLE = ("position_m", "velocity_m_per_s", "gauge_pa", "age_s")
_MOTION = ("memory", "begin_m", "end_m", "gauge_pa", "step_s")
"""The muscle moves straight from `begin_m` to `end_m`."""
_HELD = ("memory", "begin", "end", "step_s")
"""What enters the place goes straight from `begin` to `end`; a command is constant in a step."""

PLACES: dict[str, Place] = {
    "numbers": Place(
        "numbers", "the plant's numbers (PaperParameters)", ("numbers",), (), "numbers"
    ),
    "command": Place(
        "valve", "command to the spool, V", ("command_v", "age_s"), _HELD, "command_v"
    ),
    "opening": Place(
        "valve",
        "opening, in volts of the command that opens the paper's valve as far",
        ("opening_v", "age_s"),
        _HELD,
        "opening_v",
    ),
    "flow": Place(
        "air",
        "added mass flow into the muscle, kg/s",
        ("opening_v", "pressure_pa", "position_m", "age_s"),
    ),
    "volume": Place(
        "air", "volume of the air, m^3", ("volume_m3", "position_m", "pressure_pa"), (), "volume_m3"
    ),
    "pulling_pressure": Place(
        "mechanics", "gauge pressure that pulls, Pa", ("pulling_pa", *_MUSCLE), (), "pulling_pa"
    ),
    "force": Place("mechanics", "added pull, N; in the direction of contraction", _MUSCLE, _MOTION),
    "friction": Place(
        "mechanics", "dry friction (FrictionBand)", ("band", *_MUSCLE), _MOTION, "band"
    ),
    "damping": Place("mechanics", "added damping, N s/m", _MUSCLE, _MOTION),
    "pressure_reading": Place(
        "sensors",
        "absolute pressure that the sensor shows, Pa",
        ("pressure_pa", "atmosphere_pa", "age_s"),
        _HELD,
        "pressure_pa",
    ),
    "position_reading": Place(
        "sensors",
        "displacement that the encoder shows, m",
        ("position_m", "age_s"),
        _HELD,
        "position_m",
    ),
}
"""In the order in which a step comes to them."""
