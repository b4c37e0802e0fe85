"""Experiments of a session: motions of the muscle in closed loop, valve commands in open loop.

Lengths are in mm and valve commands in V, as in an experiment file. Most forms are there twice:
what both share is in a base, and each adds the levels in its own unit.
"""

from __future__ import annotations

import collections.abc
from collections.abc import Mapping
from typing import Any, Literal

from pamctl.session.experiment_form import ExperimentForm, Floats


class Tracking(ExperimentForm, kind="tracking"):
    """Square-like motion between two set points (Sec. VI-B), closed loop."""

    offset_mm: float = 11.8
    amplitude_mm: float = 5.4
    transition_s: float = 5.0
    rest_s: float = 0.0
    """At each end."""
    cycles: int = 2
    approach_s: float = 5.0
    settle_s: float = 2.0


class Hold(ExperimentForm, kind="hold"):
    """Go to a position and hold it, closed loop."""

    position_mm: float
    transition_s: float = 3.0
    hold_s: float | None = None
    """If absent, until the run stops."""


class Square(ExperimentForm, kind="square"):
    """Square wave of the valve command (Sec. VI-A), open loop; it fills first."""

    frequency_hz: float
    amplitude_v: float = 5.0
    cycles: int = 3


class Steps(ExperimentForm, kind="steps"):
    """Any sequence of valve commands, open loop."""

    steps: collections.abc.Sequence[Mapping[str, float]]
    repeat: int = 1


class ExcitationProgram(ExperimentForm, kind="program"):
    """Parts of an excitation, one after the other, in open loop."""

    seed: int = 1
    """Seed of the multisines' phases."""
    parts: collections.abc.Sequence[Mapping[str, Any]]
    forecast: Mapping[str, Any] | None = None
    """What a diagnosis expects of it; it moves nothing."""


# --- what the two units share --------------------------------------------------------------


class _SwingInMm(ExperimentForm):
    offset_mm: float = 0.0
    amplitude_mm: float
    """Highest peak."""


class _SwingInVolts(ExperimentForm):
    offset_v: float = 0.0
    amplitude_v: float
    """Highest peak."""


class _Periodic(ExperimentForm):
    trigger: str | None = None
    """Mark at the start of each period, numbered."""


# --- waves ---------------------------------------------------------------------------------


class _Sine(_Periodic):
    frequency_hz: float
    cycles: int = 10
    fade_s: float | None = None
    """Time to grow and to decay; one period if absent."""


class Sine(_Sine, _SwingInMm, kind="sine"):
    """A sine; of the muscle."""


class ValveSine(_Sine, _SwingInVolts, kind="valve_sine"):
    """A sine; of the valve, in open loop."""


class _Multisine(_Periodic):
    low_hz: float
    high_hz: float
    period_s: float
    periods: int = 4
    tones: int = 20
    seed: int = 1
    fade_s: float = 1.0
    """Time to grow and to decay."""


class Multisine(_Multisine, _SwingInMm, kind="multisine"):
    """Many tones at once; of the muscle."""


class ValveMultisine(_Multisine, _SwingInVolts, kind="valve_multisine"):
    """Many tones at once; of the valve, in open loop."""


class _Chirp(ExperimentForm):
    start_hz: float
    end_hz: float
    duration_s: float
    spacing: Literal["logarithmic", "linear"] = "logarithmic"
    fade_s: float | None = None
    """Time to grow and to decay, within duration_s; if absent, a period of the frequency there."""
    trigger: str | None = None
    """Mark at the start."""


class Chirp(_Chirp, _SwingInMm, kind="chirp"):
    """A tone of changing frequency; of the muscle."""


class ValveChirp(_Chirp, _SwingInVolts, kind="valve_chirp"):
    """A tone of changing frequency; of the valve, in open loop."""


class _Random(ExperimentForm):
    low_hz: float = 0.0
    high_hz: float
    duration_s: float
    seed: int = 1
    fade_s: float = 1.0
    """Time to grow and to decay."""


class Random(_Random, _SwingInMm, kind="random"):
    """Random motion within a band; of the muscle."""


class ValveRandom(_Random, _SwingInVolts, kind="valve_random"):
    """Random motion within a band; of the valve, in open loop."""


class _Triangle(_Periodic):
    frequency_hz: float
    rounding: float = 0.2
    """Share of the time spent in corners."""
    cycles: int = 5


class Triangle(_Triangle, _SwingInMm, kind="triangle"):
    """A triangle wave with rounded corners, in which it has its peaks; of the muscle."""


class ValveTriangle(_Triangle, _SwingInVolts, kind="valve_triangle"):
    """A triangle wave with rounded corners, in which it has its peaks; of the valve, open loop."""


# --- levels, each motion with a highest jerk of a step or corner ---------------------------


class _RoundedSquare(_Periodic):
    frequency_hz: float
    cycles: int = 5


class RoundedSquare(_RoundedSquare, _SwingInMm, kind="rounded_square"):
    """A square wave with rounded transitions; of the muscle."""

    jerk_mm_per_s3: float


class ValveRoundedSquare(_RoundedSquare, _SwingInVolts, kind="valve_rounded_square"):
    """A square wave with rounded transitions; of the valve, in open loop."""

    jerk_v_per_s3: float


class _Ramps(_Periodic):
    hold_s: float = 1.0
    """At each level."""
    cycles: int = 1


class Ramps(_Ramps, kind="ramps"):
    """Ramps from level to level; of the muscle."""

    levels_mm: Floats
    speed_mm_per_s: float
    jerk_mm_per_s3: float


class ValveRamps(_Ramps, kind="valve_ramps"):
    """Ramps from level to level; of the valve, in open loop."""

    levels_v: Floats
    speed_v_per_s: float
    jerk_v_per_s3: float


class _Staircase(_Periodic):
    hold_s: float = 2.0
    """At each level."""
    cycles: int = 1


class Staircase(_Staircase, kind="staircase"):
    """Smooth steps from level to level; of the muscle."""

    levels_mm: Floats
    jerk_mm_per_s3: float


class ValveStaircase(_Staircase, kind="valve_staircase"):
    """Smooth steps from level to level; of the valve, in open loop."""

    levels_v: Floats
    jerk_v_per_s3: float


# --- points --------------------------------------------------------------------------------


class _Table(_Periodic):
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
    cycles: int = 1


class Table(_Table, kind="table"):
    """Points of a CSV or MAT file, joined smoothly; of the muscle."""

    values_mm: Floats = ()


class ValveTable(_Table, kind="valve_table"):
    """Points of a CSV or MAT file, joined smoothly; of the valve, in open loop."""

    values_v: Floats = ()
