"""The operators: how a driver acts, as a shape that a term's size multiplies.

    constant      1                          dead_zone    -clip(q, -w, w) / Q
    gain          q / Q                      saturation   (clip(q, -w, w) - q) / Q
    curve         five hats from low to high lag          (z - q) / Q,  w z' = q - z
    beyond        max(q - w, 0) / Q          play         (z - q) / Q,  |z - q| <= w / 2
    wave          sin(2 pi q / w + phase)    slew         (z - q) / Q,  |z'| <= w
    onset         0 before w, 1 after        hysteresis   z,  dz = (sign(dq) - z) |dq| / w

q is the driver, w the term's inner number in the driver's unit (a time for `lag`, a rate for
`slew`), Q the driver's reference: 1 V, 10 mm, 100 kPa, 0.1 m/s, 1 s. The hysteresis is Bouc and
Wen's state: it depends on the last reversal, and not on the rate. All are kernels.
"""

from __future__ import annotations

from math import exp, pi, sin
from typing import NamedTuple

from pamctl.plant.effects.air.line_restriction import lag_weights
from pamctl.plant.effects.play import follow_with_play

OPERATORS = (
    "constant",
    "gain",
    "curve",
    "beyond",
    "wave",
    "onset",
    "dead_zone",
    "saturation",
    "lag",
    "play",
    "slew",
    "hysteresis",
)
COMMAND_AT, FILLING_AT, EXHAUSTING_AT, SUPPLY_AT, FLOW_AT, VOLUME_AT = range(6)
FORCE_AT, STIFFNESS_AT, DAMPING_AT, BRAID_AT, DRY_AT, PULL_AT, PRESSING_AT = range(6, 13)
PRESSURE_SENSOR_AT, ENCODER_AT, OPENING_AT = range(13, 16)
"""Places of the locations in `LOCATIONS` (`locations.py`)."""

CONSTANT, GAIN, CURVE, BEYOND, WAVE, ONSET = range(6)
DEAD_ZONE, SATURATION, LAG, PLAY, SLEW, HYSTERESIS = range(6, 12)
WITH_MEMORY = ("lag", "play", "slew", "hysteresis")

NEEDS_INNER = ("wave", "dead_zone", "saturation", "lag", "play", "slew", "hysteresis")
"""Operators whose inner number is a width, a period or a time."""

DRIVERS = ("command", "position", "pressure", "velocity", "time")
COMMAND, POSITION, PRESSURE, VELOCITY, TIME = range(5)
REFERENCES = {"command": 1.0, "position": 0.01, "pressure": 1e5, "velocity": 0.1, "time": 1.0}
"""What a size is for, in the driver's unit: so many newtons for each 10 mm."""
DRIVER_UNITS = {"command": "V", "position": "m", "pressure": "Pa", "velocity": "m/s", "time": "s"}

ONSET_SHARE = 0.02
"""Share of the instant over which an onset rises: a fit needs a slope."""
KNOTS = 5


def numbers_of_operator(operator: str) -> tuple[str, ...]:
    """Return the names of the numbers that an operator has beside its size."""
    if operator in ("constant", "gain"):
        return ()
    if operator == "curve":
        return ("low", "high", *(f"knot_{k}" for k in range(1, KNOTS + 1)))
    return ("inner", "phase") if operator == "wave" else ("inner",)


class PlantTerm(NamedTuple):
    """The numbers of a term; without a size it does not act."""

    size: float = 0.0
    location: float = -1.0
    """Place in `LOCATIONS` (`locations.py`)."""
    operator: float = 0.0
    """Place in `OPERATORS`."""
    driver: float = 0.0
    """Place in `DRIVERS`."""
    inner: float = 1.0
    phase: float = 0.0
    """Of a wave, rad."""
    low: float = 0.0
    """Where a curve begins."""
    high: float = 1.0
    knot_1: float = 0.0
    knot_2: float = 0.0
    knot_3: float = 0.0
    knot_4: float = 0.0
    knot_5: float = 0.0


class TermMemory(NamedTuple):
    """What a lag, a play, a slew limit or a hysteresis remembers."""

    kept: float = 0.0
    is_on: float = 0.0
    """0 until the first step, which sets what is kept to the driver's first value."""


class Terms(NamedTuple):
    """The terms of a plant: one for each part of a step. None of a plant: it has no terms."""

    valve: PlantTerm = PlantTerm()
    air: PlantTerm = PlantTerm()
    mechanics: PlantTerm = PlantTerm()
    sensors: PlantTerm = PlantTerm()


def reference_of(term: PlantTerm) -> float:
    """Return the driver's reference, Q; equal to `REFERENCES`."""
    if term.driver == POSITION:
        return 0.01
    if term.driver == PRESSURE:
        return 1e5
    if term.driver == VELOCITY:
        return 0.1
    return 1.0


def shape_of(term: PlantTerm, value: float, memory: TermMemory) -> float:
    """Return the shape at a driver's value; a term's effect is its size times this."""
    operator = term.operator
    if operator == CONSTANT:
        return 1.0
    if operator == GAIN:
        return value / reference_of(term)
    if operator == CURVE:
        return bend_curve(term, value)
    if operator == BEYOND:
        return max(value - term.inner, 0.0) / reference_of(term)
    if operator == WAVE:
        return sin(2.0 * pi * value / term.inner + term.phase)
    if operator == ONSET:
        rise = ONSET_SHARE * term.inner
        return min(max((value - term.inner) / rise, 0.0), 1.0) if rise > 0.0 else 1.0
    clipped = min(max(value, -term.inner), term.inner)
    if operator == DEAD_ZONE:
        return -clipped / reference_of(term)
    if operator == SATURATION:
        return (clipped - value) / reference_of(term)
    if memory.is_on == 0.0:
        return 0.0
    if operator == HYSTERESIS:
        return memory.kept
    return (memory.kept - value) / reference_of(term)


def bend_curve(term: PlantTerm, value: float) -> float:
    """Return the curve through the five knots: linear between them, constant beyond."""
    along = (KNOTS - 1) * (value - term.low) / (term.high - term.low)
    if along <= 1.0:
        return term.knot_1 + max(along, 0.0) * (term.knot_2 - term.knot_1)
    if along <= 2.0:
        return term.knot_2 + (along - 1.0) * (term.knot_3 - term.knot_2)
    if along <= 3.0:
        return term.knot_3 + (along - 2.0) * (term.knot_4 - term.knot_3)
    return term.knot_4 + min(along - 3.0, 1.0) * (term.knot_5 - term.knot_4)


def follow_value(
    term: PlantTerm, memory: TermMemory, begin: float, end: float, step_s: float
) -> TermMemory:
    """Return the memory after a step in which the driver goes linearly from `begin` to `end`."""
    operator = term.operator
    kept = memory.kept
    if memory.is_on == 0.0 and operator != HYSTERESIS:
        kept = begin
    if operator == LAG:
        share, weight = lag_weights(term.inner, step_s)
        kept = share * kept + (1.0 - share) * begin + weight * (end - begin)
    elif operator == PLAY:
        kept = follow_with_play(kept, end, term.inner)
    elif operator == SLEW:
        way = term.inner * step_s
        kept += min(max(end - kept, -way), way)
    elif operator == HYSTERESIS and end != begin and term.inner > 0.0:
        limit = 1.0 if end > begin else -1.0
        kept = limit + (kept - limit) * exp(-abs(end - begin) / term.inner)
    return TermMemory(kept, 1.0)
