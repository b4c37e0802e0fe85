"""Motions of the muscle, in closed loop; lengths are in mm, as in an experiment file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from pamctl.session.experiment_form import ExperimentForm, Floats


@dataclass(frozen=True, kw_only=True)
class Tracking(ExperimentForm):
    """Square-like motion between two set points (Sec. VI-B), closed loop."""

    KIND: ClassVar[str] = "tracking"
    offset_mm: float = 11.8
    amplitude_mm: float = 5.4
    transition_s: float = 5.0
    rest_s: float = 0.0
    """At each end."""
    cycles: int = 2
    approach_s: float = 5.0
    settle_s: float = 2.0


@dataclass(frozen=True, kw_only=True)
class Hold(ExperimentForm):
    """Go to a position and hold it, closed loop."""

    KIND: ClassVar[str] = "hold"
    position_mm: float
    transition_s: float = 3.0
    hold_s: float | None = None
    """If absent, until the run stops."""


@dataclass(frozen=True, kw_only=True)
class Sine(ExperimentForm):
    """A sine; of the muscle."""

    KIND: ClassVar[str] = "sine"
    offset_mm: float = 0.0
    amplitude_mm: float
    frequency_hz: float
    cycles: int = 10
    fade_s: float | None = None
    """Time to grow and to decay; one period if absent."""
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class Multisine(ExperimentForm):
    """Many tones at once; of the muscle."""

    KIND: ClassVar[str] = "multisine"
    offset_mm: float = 0.0
    amplitude_mm: float
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
class Chirp(ExperimentForm):
    """A tone of changing frequency; of the muscle."""

    KIND: ClassVar[str] = "chirp"
    offset_mm: float = 0.0
    amplitude_mm: float
    start_hz: float
    end_hz: float
    duration_s: float
    spacing: Literal["logarithmic", "linear"] = "logarithmic"
    fade_s: float | None = None
    """Time to grow and to decay, within duration_s; if absent, a period of the frequency there."""
    trigger: str | None = None
    """Mark at the start."""


@dataclass(frozen=True, kw_only=True)
class Random(ExperimentForm):
    """Random motion within a band; of the muscle."""

    KIND: ClassVar[str] = "random"
    offset_mm: float = 0.0
    amplitude_mm: float
    """Highest peak."""
    low_hz: float = 0.0
    high_hz: float
    duration_s: float
    seed: int = 1
    fade_s: float = 1.0
    """Time to grow and to decay."""


@dataclass(frozen=True, kw_only=True)
class RoundedSquare(ExperimentForm):
    """A square wave with rounded transitions; of the muscle."""

    KIND: ClassVar[str] = "rounded_square"
    offset_mm: float = 0.0
    amplitude_mm: float
    frequency_hz: float
    jerk_mm_per_s3: float
    """The highest jerk of a step or corner."""
    cycles: int = 5
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class Triangle(ExperimentForm):
    """A triangle wave with rounded corners; of the muscle."""

    KIND: ClassVar[str] = "triangle"
    offset_mm: float = 0.0
    amplitude_mm: float
    """Reached in the corners."""
    frequency_hz: float
    rounding: float = 0.2
    """Share of the time spent in corners."""
    cycles: int = 5
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class Ramps(ExperimentForm):
    """Ramps from level to level; of the muscle."""

    KIND: ClassVar[str] = "ramps"
    levels_mm: Floats
    speed_mm_per_s: float
    jerk_mm_per_s3: float
    """The highest jerk of a step or corner."""
    hold_s: float = 1.0
    """At each level."""
    cycles: int = 1
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class Staircase(ExperimentForm):
    """Smooth steps from level to level; of the muscle."""

    KIND: ClassVar[str] = "staircase"
    levels_mm: Floats
    hold_s: float = 2.0
    """At each level."""
    jerk_mm_per_s3: float
    """The highest jerk of a step or corner."""
    cycles: int = 1
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


@dataclass(frozen=True, kw_only=True)
class Table(ExperimentForm):
    """Points of a CSV or MAT file, joined smoothly; of the muscle."""

    KIND: ClassVar[str] = "table"
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
    values_mm: Floats = ()
    cycles: int = 1
    trigger: str | None = None
    """Mark at the start of each period, numbered."""
