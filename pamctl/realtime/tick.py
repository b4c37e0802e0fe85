"""One tick, from raw sample to admitted command: the same for card, simulation and replay.

    RawSample -> Measurement -> Estimate -> Command -> Decision

`around_the_law` can undo known effects of sensors and valve on both sides of the law.
Safety judges what the sensors show, and clips what goes to the valve.

The tick is pure: it has no clock, no rig, no log. The loop around it reads the rig, calls it,
writes, and records what was really written. The batch simulation compiles this very function.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

from hal.calibration import Calibration, Zero, position_m, pressure_pa
from hal.rig import RawSample
from pamctl.control.around_the_law import (
    Compensation,
    compensate_command,
    correct_measurement,
    follow_compensation,
)
from pamctl.control.filters import UNPRIMED, FilterGains, FilterState, estimate
from pamctl.control.law import Gains, Memory, respond
from pamctl.safety import INITIAL_SAFETY_STATE, Limits, SafetyState, admit
from pamctl.signals import Command, Compensated, Decision, Estimate, Measurement, Reference, Timing


class TickSetup(NamedTuple):
    """What does not change while the loop runs."""

    calibration: Calibration
    filters: FilterGains
    gains: Gains
    armed: Memory
    """The memory of the law that the gains belong to, when it has just been switched on."""
    limits: Limits
    compensation: Compensation | None = None
    """What is undone of sensors and valve; None undoes nothing."""


class TickState(NamedTuple):
    """The results of the last tick, and all that the next tick needs of it.

    The state is frozen into the log once a second, so that a replay can start there.
    """

    zero: Zero
    measurement: Measurement
    estimate: Estimate
    command: Command
    filters: FilterState
    law: Memory
    safety: SafetyState
    compensated: Compensated | None
    """None where nothing is undone."""


def step(
    setup: TickSetup, state: TickState, raw: RawSample, reference: Reference, timing: Timing
) -> tuple[TickState, Decision]:
    """Run one tick."""
    measurement = measure(setup.calibration, state.zero, raw)
    corrected = correct_measurement(setup.compensation, measurement)
    estimated, filters = estimate(setup.filters, state.filters, corrected, reference, timing.dt_s)
    command, law = respond(setup.gains, setup.armed, state.law, reference, estimated, timing.dt_s)
    asked = compensate_command(setup.compensation, reference, command)
    decision, safety = admit(
        setup.limits, state.safety, raw, measurement, reference, estimated, asked, timing
    )
    compensated = follow_compensation(setup.compensation, state.compensated, corrected, asked)
    return (
        TickState(state.zero, measurement, estimated, command, filters, law, safety, compensated),
        decision,
    )


def measure(calibration: Calibration, zero: Zero, raw: RawSample) -> Measurement:
    """Turn volts and counts into pascals and metres."""
    return Measurement(
        position_m(calibration, zero, raw.encoder_counts),
        pressure_pa(calibration, zero, raw.pressure_v),
    )


def first_state(setup: TickSetup, zero: Zero) -> TickState:
    """Return the state before the first tick: only the zeros and the safe valve are known."""
    return TickState(
        zero,
        Measurement(math.nan, math.nan),
        Estimate(math.nan, math.nan, math.nan, math.nan, math.nan),
        Command(math.nan, math.nan, math.nan, math.nan, False),
        UNPRIMED,
        setup.armed,
        INITIAL_SAFETY_STATE._replace(valve_v=setup.limits.safe_valve_v),
        None if setup.compensation is None else Compensated(math.nan, math.nan, math.nan),
    )


def rezero_state(setup: TickSetup, state: TickState, zero: Zero) -> TickState:
    """Start afresh with other zeros: positions and pressures are not what they were.

    Only the valve stays where it is.
    """
    fresh = first_state(setup, zero)
    return fresh._replace(safety=fresh.safety._replace(valve_v=state.safety.valve_v))


State = TypeVar("State")


def freeze_state(state: object) -> list[float]:
    """Flatten a tick's state, tuples in tuples, into doubles."""
    if isinstance(state, tuple):
        return [number for part in state for number in freeze_state(part)]
    return [] if state is None else [float(state)]  # type: ignore[arg-type]


def keyframe_fields(state: object, path: str = "") -> list[str]:
    """Name the doubles that `freeze_state` makes: `filters.rate.pole` and the like."""
    if state is None:
        return []
    if not isinstance(state, tuple):
        return [path]
    return [
        field
        for name, part in zip(_name_parts(state, path), state, strict=True)
        for field in keyframe_fields(part, name)
    ]


def thaw_state(like: State, numbers: Mapping[str, float]) -> State:
    """Return the doubles of a keyframe, by name, in the shape of another state.

    A number of `like` that the keyframe lacks keeps its value: the keyframe is older. Names that
    `like` does not have are left out.
    """
    shaped: State = _shape_numbers(like, numbers, "")
    return shaped


def _shape_numbers(like: Any, numbers: Mapping[str, float], path: str) -> Any:
    if like is None:
        return None
    if not isinstance(like, tuple):
        return type(like)(numbers.get(path, like))
    names = _name_parts(like, path)
    parts = (_shape_numbers(p, numbers, name) for p, name in zip(like, names, strict=True))
    return type(like)._make(parts)  # type: ignore[attr-defined]


def _name_parts(state: tuple[Any, ...], path: str) -> list[str]:
    names = getattr(state, "_fields", None) or map(str, range(len(state)))
    prefix = f"{path}." if path else ""
    return [prefix + name for name in names]
