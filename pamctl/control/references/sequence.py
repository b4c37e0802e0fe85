"""Sequences of forms, with pauses, marks, gain changes and repeats between them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from hal.configured import Configured
from pamctl.control.course import Plan
from pamctl.control.references.forms import Count, Form, Seconds
from pamctl.control.references.kinds import MuscleMoveSettings, StandingForm, ValveMoveSettings
from pamctl.control.references.sketch import Sketch


class PausePart(Configured):
    """Stay where the part before has ended."""

    kind: Literal["pause"]
    duration_s: Seconds


class MarkPart(Configured):
    """A remark for the log."""

    kind: Literal["mark"]
    text: Annotated[str, Field(min_length=1, max_length=200)]


class GainsPart(Configured):
    """Keys of the controller that change on a ramp; after the run they are as before it."""

    kind: Literal["gains"]
    set: Annotated[
        dict[str, float | int | bool | str],
        Field(min_length=1, description="keys of the controller, such as lambda_per_s: 20"),
    ]
    ramp_s: Annotated[float, Field(ge=0, le=60)] = 0.5


class RepeatPart(Configured):
    """Parts that are run several times."""

    kind: Literal["repeat"]
    times: Count
    parts: Annotated[tuple[Part, ...], Field(min_length=1, max_length=1000)]


Part = Annotated[
    StandingForm
    | MuscleMoveSettings
    | ValveMoveSettings
    | PausePart
    | MarkPart
    | GainsPart
    | RepeatPart,
    Field(discriminator="kind"),
]


class SequenceSettings(Configured):
    """Parts one after the other: of the muscle, or of the valve.

    Between two parts the muscle moves at 4 mm/s to where the next one begins, and settles.
    """

    kind: Literal["sequence"]
    parts: Annotated[tuple[Part, ...], Field(min_length=1, max_length=1000)]

    @model_validator(mode="after")
    def _check_parts(self) -> SequenceSettings:
        forms = [part for part in _walk(self.parts) if isinstance(part, Form)]
        if not forms:
            raise ValueError("no part moves anything")
        if len({form.IS_VALVE for form in forms}) > 1:
            raise ValueError(
                "some parts move the muscle and others the valve (kind: valve_...): nobody knows "
                "where the muscle is after open loop; make two experiments of them"
            )
        return self


RepeatPart.model_rebuild()
SequenceSettings.model_rebuild()

ReferenceSettings = StandingForm | SequenceSettings
"""Every experiment that is made of forms."""


def plan_reference(settings: ReferenceSettings) -> Plan:
    """Return the course of an experiment; raise ValueError where it is too long."""
    parts = settings.parts if isinstance(settings, SequenceSettings) else (settings,)
    is_valve = any(part.IS_VALVE for part in _walk(parts) if isinstance(part, Form))
    sketch = Sketch(is_valve=is_valve)
    _draw_parts(sketch, parts)
    return sketch.finish()


def find_gain_changes(settings: object) -> tuple[GainsPart, ...]:
    """Return the gain changes of an experiment in their order; repeated ones once."""
    if not isinstance(settings, SequenceSettings):
        return ()
    return tuple(part for part in _walk(settings.parts) if isinstance(part, GainsPart))


def _draw_parts(sketch: Sketch, parts: Iterable[Any]) -> None:
    for part in parts:
        match part:
            case Form():
                part.draw(sketch)
            case PausePart():
                sketch.hold(part.duration_s)
            case MarkPart():
                sketch.mark(part.text)
            case GainsPart():
                sketch.change_gains(part.set, part.ramp_s)
            case RepeatPart():
                inner = part.parts
                sketch.repeat(part.times, lambda: _draw_parts(sketch, inner))  # noqa: B023


def _walk(parts: Iterable[Any]) -> Iterator[Any]:
    """Yield the parts, and those in repeats in their place."""
    for part in parts:
        if isinstance(part, RepeatPart):
            yield from _walk(part.parts)
        else:
            yield part
