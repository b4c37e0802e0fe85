"""Experiments: the motion or the valve commands over time, closed loop or open loop.

An experiment file becomes a list of segments. Time runs from the end of homing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.configured import Configured
from pamctl.control.course import Plan, Segment
from pamctl.control.excitation import ProgramSettings, generate_commands
from pamctl.control.references.sequence import ReferenceSettings, plan_reference
from pamctl.signals import Phase

Duration = Annotated[float, Field(gt=0, le=86_400)]
ValveVolts = Annotated[float, Field(ge=-5, le=5, description="V; positive fills")]


class TrackingSettings(Configured):
    """Square-like motion between two set points (Sec. VI-B), closed loop.

    It begins with a smooth approach from the vented muscle and a settling time. The figures of
    merit exclude both.
    """

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


class SquareSettings(Configured):
    """Square wave of the valve command (Sec. VI-A), open loop; it fills first."""

    kind: Literal["square"]
    frequency_hz: Annotated[float, Field(gt=0, le=250)]
    amplitude_v: Annotated[float, Field(gt=0, le=5)] = 5.0
    cycles: Annotated[int, Field(ge=1, le=1_000_000)] = 3


class Step(Configured):
    """A valve command held for a time."""

    valve_v: ValveVolts
    hold_s: Duration


class StepsSettings(Configured):
    """Any sequence of valve commands, open loop."""

    kind: Literal["steps"]
    steps: Annotated[tuple[Step, ...], Field(min_length=1)]
    repeat: Annotated[int, Field(ge=1, le=1_000_000)] = 1


class HoldSettings(Configured):
    """Go to a position and hold it, closed loop."""

    kind: Literal["hold"]
    position_mm: Annotated[float, Field(ge=-100, le=100)]
    transition_s: Duration = 3.0
    hold_s: Annotated[Duration | None, Field(description="if absent, until the run stops")] = None


Experiment = (
    TrackingSettings
    | SquareSettings
    | StepsSettings
    | ProgramSettings
    | HoldSettings
    | ReferenceSettings
)

ExperimentSettings = Annotated[Experiment, Field(discriminator="kind")]


def plan_experiment(settings: Experiment) -> Plan:
    """Turn an experiment file into its course, and what falls due beside it.

    Raises ValueError where repeats make it too long.
    """
    if isinstance(settings, ReferenceSettings):
        return plan_reference(settings)
    return Plan(build_segments(settings))


def build_segments(settings: Experiment) -> tuple[Segment, ...]:
    """Turn an experiment file into its segments."""
    match settings:
        case TrackingSettings():
            return tuple(_tracking_segments(settings))
        case SquareSettings():
            half_s = 0.5 / settings.frequency_hz
            wave = (
                _command_segment(settings.amplitude_v, half_s),
                _command_segment(-settings.amplitude_v, half_s),
            )
            return wave * settings.cycles
        case StepsSettings():
            return (
                tuple(_command_segment(s.valve_v, s.hold_s) for s in settings.steps)
                * settings.repeat
            )
        case ProgramSettings():
            return tuple(_command_segment(*command) for command in generate_commands(settings))
        case HoldSettings():
            return tuple(_hold_segments(settings))
        case _:
            return plan_reference(settings).segments


def _tracking_segments(settings: TrackingSettings) -> Iterator[Segment]:
    low_m = (settings.offset_mm - settings.amplitude_mm) * 1e-3
    high_m = (settings.offset_mm + settings.amplitude_mm) * 1e-3
    yield Segment(Phase.APPROACH, settings.approach_s, 0.0, low_m, math.nan)
    if settings.settle_s:
        yield Segment(Phase.APPROACH, settings.settle_s, low_m, low_m, math.nan)
    for _ in range(settings.cycles):
        for here_m, there_m in pairwise((low_m, high_m, low_m)):
            if settings.rest_s:
                yield Segment(Phase.REST, settings.rest_s, here_m, here_m, math.nan)
            yield Segment(Phase.TRACK, settings.transition_s, here_m, there_m, math.nan)


def _hold_segments(settings: HoldSettings) -> Iterator[Segment]:
    there_m = settings.position_mm * 1e-3
    yield Segment(Phase.TRACK, settings.transition_s, 0.0, there_m, math.nan)
    yield Segment(Phase.REST, settings.hold_s or math.inf, there_m, there_m, math.nan)


def _command_segment(valve_v: float, duration_s: float) -> Segment:
    return Segment(Phase.OPEN_LOOP, duration_s, math.nan, math.nan, valve_v)
