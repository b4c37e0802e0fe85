"""Sequences of motions or of valve commands, and what stands between their parts."""

from __future__ import annotations

import collections.abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from pamctl.session.experiment_form import ExperimentForm


@dataclass(frozen=True, kw_only=True)
class Move(ExperimentForm):
    """From rest to rest, within a sequence; of the muscle."""

    KIND: ClassVar[str] = "move"
    IS_PART: ClassVar[bool] = True
    to_mm: float
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class ValveMove(ExperimentForm):
    """From rest to rest, within a sequence; of the valve, in open loop."""

    KIND: ClassVar[str] = "valve_move"
    IS_PART: ClassVar[bool] = True
    to_v: float
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class Pause(ExperimentForm):
    """Stay where the part before has ended."""

    KIND: ClassVar[str] = "pause"
    IS_PART: ClassVar[bool] = True
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class Mark(ExperimentForm):
    """A remark for the log."""

    KIND: ClassVar[str] = "mark"
    IS_PART: ClassVar[bool] = True
    text: str


@dataclass(frozen=True, kw_only=True)
class Gains(ExperimentForm):
    """Keys of the controller that change on a ramp; after the run they are as before it."""

    KIND: ClassVar[str] = "gains"
    IS_PART: ClassVar[bool] = True
    set: Mapping[str, float | int | bool | str]
    """Keys of the controller, such as lambda_per_s: 20."""
    ramp_s: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Repeats(ExperimentForm):
    """Parts that are run several times."""

    KIND: ClassVar[str] = "repeat"
    IS_PART: ClassVar[bool] = True
    times: int
    parts: collections.abc.Sequence[ExperimentForm]


@dataclass(frozen=True, kw_only=True)
class MotionSequence(ExperimentForm):
    """Parts one after the other: of the muscle, or of the valve."""

    KIND: ClassVar[str] = "sequence"
    parts: collections.abc.Sequence[ExperimentForm]
