"""Sequences of motions or of valve commands, and what stands between their parts."""

from __future__ import annotations

import collections.abc
from collections.abc import Mapping

from pamctl.session.experiment_form import ExperimentForm


class Move(ExperimentForm, kind="move", is_part=True):
    """From rest to rest, within a sequence; of the muscle."""

    to_mm: float
    duration_s: float


class ValveMove(ExperimentForm, kind="valve_move", is_part=True):
    """From rest to rest, within a sequence; of the valve, in open loop."""

    to_v: float
    duration_s: float


class Pause(ExperimentForm, kind="pause", is_part=True):
    """Stay where the part before has ended."""

    duration_s: float


class Mark(ExperimentForm, kind="mark", is_part=True):
    """A remark for the log."""

    text: str


class Gains(ExperimentForm, kind="gains", is_part=True):
    """Keys of the controller that change on a ramp; after the run they are as before it."""

    set: Mapping[str, float | int | bool | str]
    """Keys of the controller, such as lambda_per_s: 20."""
    ramp_s: float = 0.5


class Repeats(ExperimentForm, kind="repeat", is_part=True):
    """Parts that are run several times."""

    times: int
    parts: collections.abc.Sequence[ExperimentForm]


class MotionSequence(ExperimentForm, kind="sequence"):
    """Parts one after the other: of the muscle, or of the valve."""

    parts: collections.abc.Sequence[ExperimentForm]
