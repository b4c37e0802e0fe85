# Written by `python scripts/generate_reference.py`: change the code, not this file.
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from pamctl.session import gym as gym
from pamctl.session.daemon_rig import DaemonRig as DaemonRig
from pamctl.session.daemon_rig import connect as connect
from pamctl.session.experiment_form import ExperimentForm as ExperimentForm
from pamctl.session.pamctl_error import PamctlError as PamctlError
from pamctl.session.run import Run as Run
from pamctl.session.run import RunMetrics as RunMetrics
from pamctl.session.run import find_gains as find_gains
from pamctl.session.run import find_missing_effects as find_missing_effects
from pamctl.session.simulated_rig import SimulatedRig as SimulatedRig
from pamctl.session.simulated_rig import simulate as simulate
from pamctl.session.steered_rig import SteeredRig as SteeredRig

__version__: str

class Chirp(ExperimentForm):
    """One tone from one frequency to another, evenly over the octaves or over the frequencies. Of
    the muscle, in closed loop."""
    offset_mm: float = ...
    amplitude_mm: float
    start_hz: float
    end_hz: float
    duration_s: float
    spacing: Literal["logarithmic", "linear"] = ...
    fade_s: float | None = ...
    """time to grow and to decay, within duration_s; if absent, a period of the frequency there, a
    tenth of the duration at most"""
    trigger: str | None = ...
    """mark at the start"""

class ExcitationProgram(ExperimentForm):
    """Parts of an excitation, one after the other, in open loop."""
    seed: int = ...
    """seed of the multisines' phases"""
    parts: Sequence[ExperimentForm]
    forecast: Mapping[str, Any] | None = ...
    """written by `pamctl diagnose`; it moves nothing"""

class Gains(ExperimentForm):
    """Keys of the controller that change on a ramp; after the run they are as before it."""
    set: Mapping[str, float | int | bool | str]
    """keys of the controller, such as lambda_per_s: 20"""
    ramp_s: float = ...

class Hold(ExperimentForm):
    """Go to a position and hold it, closed loop."""
    position_mm: float
    transition_s: float = ...
    hold_s: float | None = ...
    """if absent, until the run stops"""

class Mark(ExperimentForm):
    """A remark for the log."""
    text: str

class MotionSequence(ExperimentForm):
    """Parts one after the other: of the muscle, or of the valve. Between two parts the muscle moves
    at 4 mm/s to where the next one begins, and settles."""
    parts: Sequence[ExperimentForm]

class Move(ExperimentForm):
    """From rest to rest, as the motions of the paper's experiments; within a sequence. Of the
    muscle, in closed loop."""
    to_mm: float
    duration_s: float

class Multisine(ExperimentForm):
    """Many tones at once, all of them multiples of 1 / period_s: for frequency responses. They are
    spread evenly over the octaves, of equal amplitude, with phases drawn from the seed. Of the
    muscle, in closed loop."""
    offset_mm: float = ...
    amplitude_mm: float
    """highest peak"""
    low_hz: float
    high_hz: float
    period_s: float
    periods: int = ...
    tones: int = ...
    seed: int = ...
    fade_s: float = ...
    """time to grow and to decay"""
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class Pause(ExperimentForm):
    """Stay where the part before has ended."""
    duration_s: float

class Ramps(ExperimentForm):
    """At constant speed from level to level, with corners of a given highest jerk. Of the muscle,
    in closed loop."""
    levels_mm: Sequence[float]
    speed_mm_per_s: float
    jerk_mm_per_s3: float
    """the highest jerk of a step or corner"""
    hold_s: float = ...
    """at each level"""
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class Random(ExperimentForm):
    """Random motion within a band of frequencies; another seed gives another motion. Of the muscle,
    in closed loop."""
    offset_mm: float = ...
    amplitude_mm: float
    """highest peak"""
    low_hz: float = ...
    high_hz: float
    duration_s: float
    seed: int = ...
    fade_s: float = ...
    """time to grow and to decay"""

class Repeats(ExperimentForm):
    """Parts that are run several times."""
    times: int
    parts: Sequence[ExperimentForm]

class RoundedSquare(ExperimentForm):
    """Between two levels, with transitions of a given highest jerk; it begins at the lower one. Of
    the muscle, in closed loop."""
    offset_mm: float = ...
    amplitude_mm: float
    frequency_hz: float
    jerk_mm_per_s3: float
    """the highest jerk of a step or corner"""
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class Sine(ExperimentForm):
    """A sine about an offset; `cycles` at full amplitude. Of the muscle, in closed loop."""
    offset_mm: float = ...
    amplitude_mm: float
    frequency_hz: float
    cycles: int = ...
    fade_s: float | None = ...
    """time to grow and to decay; one period if absent"""
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class Square(ExperimentForm):
    """Square wave of the valve command (Sec. VI-A), open loop; it fills first."""
    frequency_hz: float
    amplitude_v: float = ...
    """V"""
    cycles: int = ...

class Staircase(ExperimentForm):
    """Steps from level to level, each smoothed to a given highest jerk; two levels are a step. Of
    the muscle, in closed loop."""
    levels_mm: Sequence[float]
    hold_s: float = ...
    """at each level"""
    jerk_mm_per_s3: float
    """the highest jerk of a step or corner"""
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class Steps(ExperimentForm):
    """Any sequence of valve commands, open loop."""
    steps: Sequence[Mapping[str, Any]]
    repeat: int = ...

class Table(ExperimentForm):
    """Points of a CSV or MAT file, or written here, joined with a continuous third derivative. The
    curve is at rest at its first and its last point. A file is read once, before the run: its
    points travel in `t_s` and `values` from there on. Of the muscle, in closed loop."""
    file: str | None = ...
    """CSV or MAT file; from this file's folder"""
    time_column: str | None = ...
    """if absent, the column whose name states a time"""
    value_column: str | None = ...
    """if absent, the column whose name states the quantity"""
    unit: str | None = ...
    """of the value column; if absent, that of its name"""
    every: int = ...
    """take each n-th row only"""
    t_s: Sequence[float] = ...
    values_mm: Sequence[float] = ...
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class Tracking(ExperimentForm):
    """Square-like motion between two set points (Sec. VI-B), closed loop. It begins with a smooth
    approach from the vented muscle and a settling time. The figures of merit exclude both."""
    offset_mm: float = ...
    amplitude_mm: float = ...
    transition_s: float = ...
    rest_s: float = ...
    """at each end"""
    cycles: int = ...
    approach_s: float = ...
    settle_s: float = ...

class Triangle(ExperimentForm):
    """Constant speed up and down, with rounded corners; it begins at the lower end. Of the muscle,
    in closed loop."""
    offset_mm: float = ...
    amplitude_mm: float
    """reached in the corners"""
    frequency_hz: float
    rounding: float = ...
    """share of the time spent in corners"""
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class ValveChirp(ExperimentForm):
    """One tone from one frequency to another, evenly over the octaves or over the frequencies. Of
    the valve, in open loop."""
    offset_v: float = ...
    amplitude_v: float
    start_hz: float
    end_hz: float
    duration_s: float
    spacing: Literal["logarithmic", "linear"] = ...
    fade_s: float | None = ...
    """time to grow and to decay, within duration_s; if absent, a period of the frequency there, a
    tenth of the duration at most"""
    trigger: str | None = ...
    """mark at the start"""

class ValveMove(ExperimentForm):
    """From rest to rest, as the motions of the paper's experiments; within a sequence. Of the
    valve, in open loop."""
    to_v: float
    duration_s: float

class ValveMultisine(ExperimentForm):
    """Many tones at once, all of them multiples of 1 / period_s: for frequency responses. They are
    spread evenly over the octaves, of equal amplitude, with phases drawn from the seed. Of the
    valve, in open loop."""
    offset_v: float = ...
    amplitude_v: float
    """highest peak"""
    low_hz: float
    high_hz: float
    period_s: float
    periods: int = ...
    tones: int = ...
    seed: int = ...
    fade_s: float = ...
    """time to grow and to decay"""
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class ValveRamps(ExperimentForm):
    """At constant speed from level to level, with corners of a given highest jerk. Of the valve, in
    open loop."""
    levels_v: Sequence[float]
    speed_v_per_s: float
    jerk_v_per_s3: float
    """the highest jerk of a step or corner"""
    hold_s: float = ...
    """at each level"""
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class ValveRandom(ExperimentForm):
    """Random motion within a band of frequencies; another seed gives another motion. Of the valve,
    in open loop."""
    offset_v: float = ...
    amplitude_v: float
    """highest peak"""
    low_hz: float = ...
    high_hz: float
    duration_s: float
    seed: int = ...
    fade_s: float = ...
    """time to grow and to decay"""

class ValveRoundedSquare(ExperimentForm):
    """Between two levels, with transitions of a given highest jerk; it begins at the lower one. Of
    the valve, in open loop."""
    offset_v: float = ...
    amplitude_v: float
    frequency_hz: float
    jerk_v_per_s3: float
    """the highest jerk of a step or corner"""
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class ValveSine(ExperimentForm):
    """A sine about an offset; `cycles` at full amplitude. Of the valve, in open loop."""
    offset_v: float = ...
    amplitude_v: float
    frequency_hz: float
    cycles: int = ...
    fade_s: float | None = ...
    """time to grow and to decay; one period if absent"""
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class ValveStaircase(ExperimentForm):
    """Steps from level to level, each smoothed to a given highest jerk; two levels are a step. Of
    the valve, in open loop."""
    levels_v: Sequence[float]
    hold_s: float = ...
    """at each level"""
    jerk_v_per_s3: float
    """the highest jerk of a step or corner"""
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class ValveTable(ExperimentForm):
    """Points of a CSV or MAT file, or written here, joined with a continuous third derivative. The
    curve is at rest at its first and its last point. A file is read once, before the run: its
    points travel in `t_s` and `values` from there on. Of the valve, in open loop."""
    file: str | None = ...
    """CSV or MAT file; from this file's folder"""
    time_column: str | None = ...
    """if absent, the column whose name states a time"""
    value_column: str | None = ...
    """if absent, the column whose name states the quantity"""
    unit: str | None = ...
    """of the value column; if absent, that of its name"""
    every: int = ...
    """take each n-th row only"""
    t_s: Sequence[float] = ...
    values_v: Sequence[float] = ...
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""

class ValveTriangle(ExperimentForm):
    """Constant speed up and down, with rounded corners; it begins at the lower end. Of the valve,
    in open loop."""
    offset_v: float = ...
    amplitude_v: float
    """reached in the corners"""
    frequency_hz: float
    rounding: float = ...
    """share of the time spent in corners"""
    cycles: int = ...
    trigger: str | None = ...
    """mark at the start of each period, numbered"""
