"""Excitation for diagnosis: valve commands that reveal effects that a model lacks.

Each part shows something that the others do not. Squares show the flow and the spool. A
staircase about null shows a dead band. Multisines show effects that depend on amplitude. A
chirp distinguishes a delay from a lag. Fill-and-hold shows leaks. Long holds show creep.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from typing import Annotated, Literal, NamedTuple, TypeVar

from pydantic import Field, model_validator

from hal.configured import Configured

Volts = Annotated[float, Field(ge=-5, le=5, description="V; positive fills")]
Amplitude = Annotated[float, Field(gt=0, le=5, description="V")]
Seconds = Annotated[float, Field(ge=1e-6, le=86_400)]
Hertz = Annotated[float, Field(ge=1e-5, le=250)]

SAMPLE_S = 1e-3
"""Waves are sampled at this interval: one tick of the usual loop."""


Wave = TypeVar("Wave")


class HeldCommand(NamedTuple):
    """A valve command, and how long it is held."""

    valve_v: float
    duration_s: float


class HeldPart(Configured):
    """One command, held."""

    wave: Literal["hold"]
    valve_v: Volts
    duration_s: Seconds


class SquarePart(Configured):
    """Full strokes; the first one fills."""

    wave: Literal["square"]
    frequency_hz: Hertz
    amplitude_v: Amplitude = 5.0
    cycles: Annotated[int, Field(ge=1, le=100_000)] = 3


class StaircasePart(Configured):
    """Small pulses to both sides of null; the valve is closed after each."""

    wave: Literal["staircase"]
    levels_v: Annotated[tuple[Amplitude, ...], Field(min_length=1)]
    hold_s: Seconds = 0.15


class MultisinePart(Configured):
    """Many tones at once, spread evenly over the octaves, with phases drawn from the seed."""

    wave: Literal["multisine"]
    low_hz: Hertz
    high_hz: Hertz
    amplitude_v: Annotated[float, Field(gt=0, le=5, description="highest peak")]
    duration_s: Seconds
    tones: Annotated[int, Field(ge=1, le=200)] = 30
    bias_v: Volts = 0.0

    @model_validator(mode="after")
    def _check_frequencies(self) -> MultisinePart:
        return _require_rising(self, self.low_hz, self.high_hz)


class ChirpPart(Configured):
    """One tone that rises evenly over the octaves."""

    wave: Literal["chirp"]
    low_hz: Hertz
    high_hz: Hertz
    amplitude_v: Amplitude
    duration_s: Seconds

    @model_validator(mode="after")
    def _check_frequencies(self) -> ChirpPart:
        return _require_rising(self, self.low_hz, self.high_hz)


Part = Annotated[
    HeldPart | SquarePart | StaircasePart | MultisinePart | ChirpPart, Field(discriminator="wave")
]


class PairForecast(Configured):
    """What the wrong one of two explanations should leave of a run."""

    true: Annotated[str, Field(min_length=1, max_length=300)]
    refuted: Annotated[str, Field(min_length=1, max_length=300)]
    block: Annotated[str, Field(description="the block that shows it best")]
    residual_over_floor: Annotated[float, Field(gt=0)]


class ForecastSettings(Configured):
    """What the diagnosis that wrote a program expects of it; a later diagnosis judges it."""

    pairs: Annotated[tuple[PairForecast, ...], Field(min_length=1)]
    pressure_kpa: Annotated[float, Field(ge=0, description="highest absolute pressure expected")]
    low_mm: Annotated[float, Field(description="lowest position expected")]
    high_mm: Annotated[float, Field(description="highest position expected")]


class ProgramSettings(Configured):
    """Parts of an excitation, one after the other, in open loop."""

    kind: Literal["program"]
    seed: Annotated[int, Field(ge=0, description="seed of the multisines' phases")] = 1
    parts: Annotated[tuple[Part, ...], Field(min_length=1)]
    forecast: Annotated[
        ForecastSettings | None,
        Field(description="written by `pamctl diagnose`; it moves nothing"),
    ] = None


def generate_commands(settings: ProgramSettings) -> Iterator[HeldCommand]:
    """Yield the program's commands in order."""
    for index, part in enumerate(settings.parts):
        match part:
            case HeldPart():
                yield HeldCommand(part.valve_v, part.duration_s)
            case SquarePart():
                half_s = 0.5 / part.frequency_hz
                for _ in range(part.cycles):
                    yield from (
                        HeldCommand(part.amplitude_v, half_s),
                        HeldCommand(-part.amplitude_v, half_s),
                    )
            case StaircasePart():
                for level_v in part.levels_v:
                    for valve_v in (level_v, 0.0, -level_v, 0.0):
                        yield HeldCommand(valve_v, part.hold_s)
            case MultisinePart():
                yield from _multisine(part, random.Random(f"{settings.seed} {index}"))
            case ChirpPart():
                yield from _chirp(part)


def _multisine(part: MultisinePart, drawn: random.Random) -> Iterator[HeldCommand]:
    ratio = (part.high_hz / part.low_hz) ** (1.0 / max(part.tones - 1, 1))
    tones = [
        (math.tau * part.low_hz * ratio**i, drawn.uniform(0.0, math.tau)) for i in range(part.tones)
    ]
    wave = [sum(math.sin(w * t_s + phase) for w, phase in tones) for t_s in _times(part.duration_s)]
    peak = max(map(abs, wave)) or 1.0
    for value in wave:
        yield _sample(part.bias_v + part.amplitude_v * value / peak)


def _chirp(part: ChirpPart) -> Iterator[HeldCommand]:
    growth = math.log(part.high_hz / part.low_hz) / part.duration_s
    for t_s in _times(part.duration_s):
        phase = math.tau * part.low_hz * math.expm1(growth * t_s) / growth
        yield _sample(part.amplitude_v * math.sin(phase))


def _times(duration_s: float) -> Iterator[float]:
    return (i * SAMPLE_S for i in range(max(round(duration_s / SAMPLE_S), 1)))


def _sample(valve_v: float) -> HeldCommand:
    return HeldCommand(min(max(valve_v, -5.0), 5.0), SAMPLE_S)


def _require_rising(part: Wave, low_hz: float, high_hz: float) -> Wave:
    if low_hz >= high_hz:
        raise ValueError(f"low_hz {low_hz:g} must lie below high_hz {high_hz:g}")
    return part
