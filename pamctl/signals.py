"""One type for each stage of the tick, in order.

    RawSample -> Measurement -> Estimate -> Command -> Decision -> TickRecord

Every field carries its unit as a suffix. Field names are unique over all stages,
because their flat list (`TICK_FIELDS`) is the row of the ring and the message
of the log. All values are in SI; pressure is absolute; a contraction of the
muscle is a positive displacement.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple, get_type_hints

from hal.rig import RawSample


class Phase(IntEnum):
    """What the loop is doing."""

    HOMING = 0
    APPROACH = 1
    TRACK = 2
    REST = 3
    OPEN_LOOP = 4
    STOPPING = 5


class Timing(NamedTuple):
    """Time of this tick. Only `dt_s`, `late_s` and `missed` may steer the tick."""

    tick: int
    """Index on the grid of periods; a gap means missed ticks."""
    t_s: float
    """Time of the encoder sample since the first tick."""
    dt_s: float
    """Measured time since the previous tick's encoder sample."""
    late_s: float
    """Delay of the wake-up after the deadline; zero without a clock."""
    missed: int
    """Grid points skipped between the previous tick and this one."""


class Measurement(NamedTuple):
    """Calibrated sensor values."""

    position_m: float
    """Displacement from the encoder, from the homed zero; positive when the muscle contracts."""
    pressure_pa: float
    """Absolute pressure in the muscle, from the sensor."""


class Reference(NamedTuple):
    """The reference motion, or in open loop the reference valve command.

    The other of the two is NaN.
    """

    phase: int
    """What the loop is doing; a value of `Phase`."""
    reference_m: float
    """Wanted displacement."""
    reference_velocity_m_per_s: float
    """Its first derivative."""
    reference_acceleration_m_per_s2: float
    """Its second derivative."""
    reference_jerk_m_per_s3: float
    """Its third derivative."""
    reference_valve_v: float
    """Open-loop valve command, -5..5 V, positive fills."""


class Estimate(NamedTuple):
    """The input of the laws. `error = position - reference`, the signs of Eq. 17."""

    position_filtered_m: float
    """Displacement behind its low-pass filter."""
    pressure_estimate_pa: float
    """As measured: the one law that uses it tolerates its noise of 300 Pa."""
    error_m: float
    """Filtered displacement minus reference."""
    error_rate_m_per_s: float
    """First derivative of the error."""
    error_acceleration_m_per_s2: float
    """Second derivative of the error."""


class Command(NamedTuple):
    """The command of the law, and its terms. See `pamctl.control.law.LawTerms`."""

    command_v: float
    """Valve command u, -5..5 V: positive fills the muscle, negative exhausts it."""
    surface_m_per_s2: float
    """Sliding surface, s of Eq. 11 for the paper's laws; NaN for laws without one."""
    equivalent_v: float
    """First part of u: for the paper's laws the equivalent control."""
    robust_v: float
    """Second part of u: for the paper's laws the robust term u_rb."""
    saturated: bool
    """The law reached its own command limit."""


class Decision(NamedTuple):
    """The command that safety admits to the valve, and its verdicts."""

    valve_v: float
    """Valve command that goes to the rig, after the limits."""
    verdicts: int
    """Bit set of `pamctl.safety.VERDICTS`: a bit for every clip and every trip."""
    tripped: bool
    """The run must end at the safe voltage."""


class TickOutcome(NamedTuple):
    """The applied output and the durations of the tick."""

    applied_v: float
    """Analog output voltage that the rig reports as applied; NaN if the write failed."""
    read_s: float
    """Duration of the rig's read; the three durations are zero without a clock."""
    compute_s: float
    """Duration from the sample to the admitted command."""
    write_s: float
    """Duration of the rig's write."""


class Truth(NamedTuple):
    """True values of a simulated rig; NaN on hardware."""

    true_position_m: float
    """Displacement of the simulated muscle, without the encoder's steps."""
    true_pressure_pa: float
    """Absolute pressure in the simulated muscle, without the sensor's noise."""


class Compensated(NamedTuple):
    """What the compensation of known effects makes of command and measurement.

    The columns of a run with `compensate`; other runs do not have them.
    """

    compensated_v: float
    """Command at which the known valve opens as `command_v` would open the ideal one."""
    corrected_position_m: float
    """Displacement as the law gets it."""
    corrected_pressure_pa: float
    """Absolute pressure as the law gets it."""


class TickRecord(NamedTuple):
    """All signals of one tick: a row of the ring, and a message of the log."""

    timing: Timing
    raw: RawSample
    measurement: Measurement
    reference: Reference
    estimate: Estimate
    command: Command
    decision: Decision
    outcome: TickOutcome
    truth: Truth
    compensation: Compensated | None = None
    """None in a run that compensates nothing."""


class Field(NamedTuple):
    """One column of the log."""

    name: str
    kind: type
    stage: str


def _flatten(stages: Mapping[str, type]) -> tuple[Field, ...]:
    return tuple(
        Field(name, kind, stage)
        for stage, signals in stages.items()
        for name, kind in get_type_hints(signals).items()
    )


TICK_STAGES: dict[str, type] = {
    stage: kind for stage, kind in get_type_hints(TickRecord).items() if stage != "compensation"
}
"""The stages of every run's ticks, in order, by their names in `TickRecord`."""
COMPENSATION_FIELDS: tuple[Field, ...] = _flatten({"compensation": Compensated})
"""The columns that a run with `compensate` adds to each tick, after all others."""
TICK_FIELDS: tuple[Field, ...] = _flatten(TICK_STAGES)
"""The columns of a tick in order, each `int`, `float` or `bool`."""


def list_tick_fields(compensates: bool) -> tuple[Field, ...]:
    """Return the columns of a run: all of `TICK_FIELDS`, and those of a compensation."""
    return (*TICK_FIELDS, *COMPENSATION_FIELDS) if compensates else TICK_FIELDS


def make_empty_record(compensates: bool) -> TickRecord:
    """Return a record of the types that a run's ticks have, all numbers 0."""
    stages: list[Any] = [
        kind(*(field.kind(0) for field in _flatten({"": kind}))) for kind in TICK_STAGES.values()
    ]
    record = TickRecord(*stages)
    return record._replace(compensation=Compensated(0.0, 0.0, 0.0)) if compensates else record


def find_followed_m(columns: Mapping[str, Any]) -> Any:
    """Return the displacement whose error counts: the corrected one in a run that corrects it."""
    name = "corrected_position_m" if "corrected_position_m" in columns else "position_m"
    return columns[name]
