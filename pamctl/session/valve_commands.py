"""Commands of the valve, in open loop; they are in V, as in an experiment file."""

from __future__ import annotations

import collections.abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from pamctl.session.experiment_form import ExperimentForm, Floats


@dataclass(frozen=True, kw_only=True)
class Square(ExperimentForm):
    """Square wave of the valve command (Sec. VI-A), open loop; it fills first."""

    KIND: ClassVar[str] = "square"
    frequency_hz: float
    amplitude_v: float = 5.0
    cycles: int = 3


@dataclass(frozen=True, kw_only=True)
class Steps(ExperimentForm):
    """Any sequence of valve commands, open loop."""

    KIND: ClassVar[str] = "steps"
    steps: collections.abc.Sequence[Mapping[str, float]]
    repeat: int = 1


@dataclass(frozen=True, kw_only=True)
class ExcitationProgram(ExperimentForm):
    """Parts of an excitation, one after the other, in open loop."""

    KIND: ClassVar[str] = "program"
    seed: int = 1
    """Seed of the multisines' phases."""
    parts: collections.abc.Sequence[Mapping[str, Any]]
    forecast: Mapping[str, Any] | None = None
    """What a diagnosis expects of it; it moves nothing."""


@dataclass(frozen=True, kw_only=True)
class ValveSine(ExperimentForm):
    """A sine; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_sine"
    offset_v: float = 0.0
    amplitude_v: float
    frequency_hz: float
    cycles: int = 10
    fade_s: float | None = None
    """Time to grow and to decay; one period if absent."""
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class ValveMultisine(ExperimentForm):
    """Many tones at once; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_multisine"
    offset_v: float = 0.0
    amplitude_v: float
    """Highest peak."""
    low_hz: float
    high_hz: float
    period_s: float
    periods: int = 4
    tones: int = 20
    seed: int = 1
    fade_s: float = 1.0
    """Time to grow and to decay."""
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class ValveChirp(ExperimentForm):
    """A tone of changing frequency; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_chirp"
    offset_v: float = 0.0
    amplitude_v: float
    start_hz: float
    end_hz: float
    duration_s: float
    spacing: Literal["logarithmic", "linear"] = "logarithmic"
    fade_s: float | None = None
    """Time to grow and to decay, within duration_s; if absent, a period of the frequency there."""
    trigger: str | None = None
    """Mark at the start."""


@dataclass(frozen=True, kw_only=True)
class ValveRandom(ExperimentForm):
    """Random motion within a band; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_random"
    offset_v: float = 0.0
    amplitude_v: float
    """Highest peak."""
    low_hz: float = 0.0
    high_hz: float
    duration_s: float
    seed: int = 1
    fade_s: float = 1.0
    """Time to grow and to decay."""


@dataclass(frozen=True, kw_only=True)
class ValveRoundedSquare(ExperimentForm):
    """A square wave with rounded transitions; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_rounded_square"
    offset_v: float = 0.0
    amplitude_v: float
    frequency_hz: float
    jerk_v_per_s3: float
    """The highest jerk of a step or corner."""
    cycles: int = 5
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class ValveTriangle(ExperimentForm):
    """A triangle wave with rounded corners; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_triangle"
    offset_v: float = 0.0
    amplitude_v: float
    """Reached in the corners."""
    frequency_hz: float
    rounding: float = 0.2
    """Share of the time spent in corners."""
    cycles: int = 5
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class ValveRamps(ExperimentForm):
    """Ramps from level to level; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_ramps"
    levels_v: Floats
    speed_v_per_s: float
    jerk_v_per_s3: float
    """The highest jerk of a step or corner."""
    hold_s: float = 1.0
    """At each level."""
    cycles: int = 1
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class ValveStaircase(ExperimentForm):
    """Smooth steps from level to level; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_staircase"
    levels_v: Floats
    hold_s: float = 2.0
    """At each level."""
    jerk_v_per_s3: float
    """The highest jerk of a step or corner."""
    cycles: int = 1
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class ValveTable(ExperimentForm):
    """Points of a CSV or MAT file, joined smoothly; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_table"
    file: str | None = None
    """CSV or MAT file; from this file's folder."""
    time_column: str | None = None
    """If absent, the column whose name states a time."""
    value_column: str | None = None
    """If absent, the column whose name states the quantity."""
    unit: str | None = None
    """Of the value column; if absent, that of its name."""
    every: int = 1
    """Take each n-th row only."""
    t_s: Floats = ()
    values_v: Floats = ()
    cycles: int = 1
    trigger: str | None = None
    """Mark at the start of each period, numbered."""
