"""Experiments: the motion or the valve commands over time, closed loop or open loop.

An experiment file becomes a course, drawn by its own class. Time runs from the end of homing.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.calibration import Configured
from pamctl.base.chosen_model import AnyModel, ChosenModel
from pamctl.control.course import Plan
from pamctl.control.forms import FORMS, Count, Drawn, Hertz, Seconds, find_form, require_rising
from pamctl.control.sketch import Sketch
from pamctl.control.waves import Sweep, Tone, Tones
from pamctl.signals import Phase

Duration = Annotated[float, Field(gt=0, le=86_400)]
ValveVolts = Annotated[float, Field(ge=-5, le=5, description="V; positive fills")]
Amplitude = Annotated[float, Field(gt=0, le=5, description="V")]

SAMPLE_S = 1e-3
"""The waves of a program are sampled at this interval: one tick of the usual loop."""


class TrackingSettings(Drawn):
    """Square-like motion between two set points (Sec. VI-B), closed loop.

    It begins with a smooth approach from the vented muscle and a settling time. The figures of
    merit exclude both.
    """

    IS_VALVE = False
    kind: Literal["tracking"]
    offset_mm: Annotated[float, Field(ge=0, le=100)] = 11.8
    amplitude_mm: Annotated[float, Field(ge=0, le=100)] = 5.4
    transition_s: Duration = 5.0
    rest_s: Annotated[float, Field(ge=0, le=86_400, description="at each end")] = 0.0
    cycles: Annotated[int, Field(ge=1, le=100_000)] = 2
    approach_s: Duration = 5.0
    settle_s: Annotated[float, Field(ge=0, le=86_400)] = 2.0

    @model_validator(mode="after")
    def _check_lower_point(self) -> TrackingSettings:
        if self.amplitude_mm > self.offset_mm:
            raise ValueError(
                f"amplitude_mm {self.amplitude_mm:g} exceeds offset_mm {self.offset_mm:g}: "
                "the lower set point would lie below the vented muscle at 0 mm"
            )
        return self

    def draw(self, sketch: Sketch) -> None:
        """Approach the lower point, and go up and down."""
        low_m = (self.offset_mm - self.amplitude_mm) * 1e-3
        high_m = (self.offset_mm + self.amplitude_mm) * 1e-3
        sketch.move(low_m, self.approach_s, Phase.APPROACH)
        if self.settle_s:
            sketch.move(low_m, self.settle_s, Phase.APPROACH)

        def draw_cycle() -> None:
            for there_m in (high_m, low_m):
                if self.rest_s:
                    sketch.hold(self.rest_s)
                sketch.move(there_m, self.transition_s)

        sketch.repeat(self.cycles, draw_cycle)


class HoldSettings(Drawn):
    """Go to a position and hold it, closed loop."""

    IS_VALVE = False
    kind: Literal["hold"]
    position_mm: Annotated[float, Field(ge=-100, le=100)]
    transition_s: Duration = 3.0
    hold_s: Annotated[Duration | None, Field(description="if absent, until the run stops")] = None

    def draw(self, sketch: Sketch) -> None:
        """Go there, and stay."""
        sketch.move(self.position_mm * 1e-3, self.transition_s)
        sketch.hold(self.hold_s or math.inf)


class _Square(Drawn):
    """A square wave of the valve command; it fills first."""

    frequency_hz: Annotated[float, Field(gt=0, le=250)]
    amplitude_v: Amplitude = 5.0
    cycles: Annotated[int, Field(ge=1, le=1_000_000)] = 3

    def draw(self, sketch: Sketch) -> None:
        """Fill, and exhaust for equally long."""
        half_s = 0.5 / self.frequency_hz

        def draw_cycle() -> None:
            sketch.hold_valve(self.amplitude_v, half_s)
            sketch.hold_valve(-self.amplitude_v, half_s)

        sketch.repeat(self.cycles, draw_cycle)


class SquareSettings(_Square):
    """Square wave of the valve command (Sec. VI-A), open loop; it fills first."""

    IS_VALVE = True
    kind: Literal["square"]


class Step(Configured):
    """A valve command held for a time."""

    valve_v: ValveVolts
    hold_s: Duration


class StepsSettings(Drawn):
    """Any sequence of valve commands, open loop."""

    IS_VALVE = True
    kind: Literal["steps"]
    steps: Annotated[tuple[Step, ...], Field(min_length=1)]
    repeat: Annotated[int, Field(ge=1, le=1_000_000)] = 1

    def draw(self, sketch: Sketch) -> None:
        """Hold the commands in their order."""

        def draw_steps() -> None:
            for step in self.steps:
                sketch.hold_valve(step.valve_v, step.hold_s)

        sketch.repeat(self.repeat, draw_steps)


# --- programs: valve commands that reveal effects that a model lacks -----------------------


class HeldPart(Drawn):
    """One command, held: a long one shows creep, and a fill before it leaks."""

    wave: Literal["hold"]
    valve_v: ValveVolts
    duration_s: Seconds

    def draw(self, sketch: Sketch) -> None:
        """Hold it."""
        sketch.hold_valve(self.valve_v, self.duration_s)


class SquarePart(_Square):
    """Full strokes, which show the flow and the spool; the first one fills."""

    wave: Literal["square"]


class StaircasePart(Drawn):
    """Small pulses to both sides of null show a dead band; the valve is closed after each."""

    wave: Literal["staircase"]
    levels_v: Annotated[tuple[Amplitude, ...], Field(min_length=1)]
    hold_s: Seconds = 0.15

    def draw(self, sketch: Sketch) -> None:
        """Go to both sides of null by each level."""
        for level_v in self.levels_v:
            for valve_v in (level_v, 0.0, -level_v, 0.0):
                sketch.hold_valve(valve_v, self.hold_s)


class _Band(Drawn):
    low_hz: Hertz
    high_hz: Hertz
    amplitude_v: Annotated[float, Field(gt=0, le=5, description="V, highest peak")]
    duration_s: Seconds

    @model_validator(mode="after")
    def _check_frequencies(self) -> _Band:
        require_rising(self.low_hz, self.high_hz)
        return self

    @property
    def samples(self) -> int:
        """How many commands are held."""
        return max(round(self.duration_s / SAMPLE_S), 1)


class MultisinePart(_Band):
    """Many tones at once, spread evenly over the octaves, with phases drawn from the seed.

    They show effects that depend on amplitude.
    """

    wave: Literal["multisine"]
    tones: Annotated[int, Field(ge=1, le=200)] = 30
    bias_v: ValveVolts = 0.0

    def draw(self, sketch: Sketch) -> None:
        """Hold samples of the tones, scaled to their peak."""
        ratio = (self.high_hz / self.low_hz) ** (1.0 / max(self.tones - 1, 1))
        tones = Tones(
            tuple(
                Tone(1.0, math.tau * self.low_hz * ratio**i, sketch.chance.uniform(0.0, math.tau))
                for i in range(self.tones)
            )
        )
        values = tones.sample(SAMPLE_S, self.samples)
        peak = max(map(abs, values)) or 1.0
        sketch.hold_each((self.bias_v + self.amplitude_v * v / peak for v in values), SAMPLE_S)


class ChirpPart(_Band):
    """One tone that rises evenly over the octaves: it distinguishes a delay from a lag."""

    wave: Literal["chirp"]

    def draw(self, sketch: Sketch) -> None:
        """Hold samples of the tone."""
        wave = Sweep(
            self.amplitude_v, self.low_hz, self.high_hz, self.duration_s, is_logarithmic=True
        )
        values = (wave.at(i * SAMPLE_S).position_m for i in range(self.samples))
        sketch.hold_each(values, SAMPLE_S)


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


class ProgramSettings(Drawn):
    """Parts of an excitation, one after the other, in open loop."""

    IS_VALVE = True
    kind: Literal["program"]
    seed: Annotated[int, Field(ge=0, description="seed of the multisines' phases")] = 1
    parts: Annotated[
        tuple[
            Annotated[
                HeldPart | SquarePart | StaircasePart | MultisinePart | ChirpPart,
                Field(discriminator="wave"),
            ],
            ...,
        ],
        Field(min_length=1),
    ]
    forecast: Annotated[
        ForecastSettings | None,
        Field(description="written by `pamctl diagnose`; it moves nothing"),
    ] = None

    def draw(self, sketch: Sketch) -> None:
        """Add the parts, each with tones of its own."""
        for index, part in enumerate(self.parts):
            sketch.chance = random.Random(f"{self.seed} {index}")
            part.draw(sketch)


# --- sequences ------------------------------------------------------------------------------


class PausePart(Drawn):
    """Stay where the part before has ended."""

    IS_PART = True
    kind: Literal["pause"]
    duration_s: Seconds

    def draw(self, sketch: Sketch) -> None:
        """Stay."""
        sketch.hold(self.duration_s)


class MarkPart(Drawn):
    """A remark for the log."""

    IS_PART = True
    kind: Literal["mark"]
    text: Annotated[str, Field(min_length=1, max_length=200)]

    def draw(self, sketch: Sketch) -> None:
        """Put the remark."""
        sketch.mark(self.text)


class GainsPart(Drawn):
    """Keys of the controller that change on a ramp; after the run they are as before it."""

    IS_PART = True
    kind: Literal["gains"]
    set: Annotated[
        dict[str, float | int | bool | str],
        Field(min_length=1, description="keys of the controller, such as lambda_per_s: 20"),
    ]
    ramp_s: Annotated[float, Field(ge=0, le=60)] = 0.5

    def draw(self, sketch: Sketch) -> None:
        """Change them."""
        sketch.change_gains(self.set, self.ramp_s)


Part = Annotated[Drawn, AnyModel("kind", lambda: PARTS, lambda kind: find_model(kind))]
Parts = Annotated[tuple[Part, ...], Field(min_length=1, max_length=1000)]


class RepeatPart(Drawn):
    """Parts that are run several times."""

    IS_PART = True
    kind: Literal["repeat"]
    times: Count
    parts: Parts

    def draw(self, sketch: Sketch) -> None:
        """Draw the parts so many times."""
        sketch.repeat(self.times, lambda: _draw_parts(sketch, self.parts))


class SequenceSettings(Drawn):
    """Parts one after the other: of the muscle, or of the valve.

    Between two parts the muscle moves at 4 mm/s to where the next one begins, and settles.
    """

    kind: Literal["sequence"]
    parts: Parts

    @model_validator(mode="after")
    def _check_parts(self) -> SequenceSettings:
        moved = {part.IS_VALVE for part in _walk(self.parts)} - {None}
        if not moved:
            raise ValueError("no part moves anything")
        if len(moved) > 1:
            raise ValueError(
                "some parts move the muscle and others the valve (kind: valve_...): nobody knows "
                "where the muscle is after open loop; make two experiments of them"
            )
        return self

    def draw(self, sketch: Sketch) -> None:
        """Draw the parts in their order."""
        _draw_parts(sketch, self.parts)

    def find_gain_changes(self) -> tuple[GainsPart, ...]:
        """Return the gain changes in their order; repeated ones once."""
        return tuple(part for part in _walk(self.parts) if isinstance(part, GainsPart))


def _draw_parts(sketch: Sketch, parts: Iterable[Drawn]) -> None:
    for part in parts:
        part.draw(sketch)


def _walk(parts: Iterable[Drawn]) -> Iterator[Drawn]:
    """Yield the parts, and those in repeats in their place."""
    for part in parts:
        if isinstance(part, RepeatPart):
            yield from _walk(part.parts)
        else:
            yield part


# --- every experiment ------------------------------------------------------------------------

_MODELS: Mapping[str, type[Drawn]] = {
    "tracking": TrackingSettings,
    "square": SquareSettings,
    "steps": StepsSettings,
    "program": ProgramSettings,
    "hold": HoldSettings,
    "sequence": SequenceSettings,
    "pause": PausePart,
    "mark": MarkPart,
    "gains": GainsPart,
    "repeat": RepeatPart,
}
PARTS = (*FORMS, "pause", "mark", "gains", "repeat")
"""The kinds that may stand within a sequence."""
_STANDING_FORMS = tuple(kind for kind, form in FORMS.items() if not form.IS_PART)
EXPERIMENTS = ("tracking", "square", "steps", "program", "hold", *_STANDING_FORMS, "sequence")
"""The kinds of an experiment file."""


def find_model(kind: str) -> type[Drawn]:
    """Return the model of an experiment, or of a part of one, by its kind."""
    return _MODELS[kind] if kind in _MODELS else find_form(kind)


Experiment = Drawn
ExperimentSettings = Annotated[
    Experiment,
    ChosenModel("kind", lambda: EXPERIMENTS, lambda k: find_model(k) if k in EXPERIMENTS else None),
]


def plan_experiment(settings: Experiment) -> Plan:
    """Return the course of an experiment; raise ValueError where repeats make it too long."""
    parts = settings.parts if isinstance(settings, SequenceSettings) else (settings,)
    sketch = Sketch(is_valve=any(part.IS_VALVE for part in _walk(parts)))
    settings.draw(sketch)
    return sketch.finish()
