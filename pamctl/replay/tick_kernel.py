"""Run the tick over a stretch of a log: the same function that the loop process calls."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hal.calibration import output_v
from hal.converter import Output, nearest_output_v
from hal.rig import RawSample
from pamctl.compiled import compile_kernel
from pamctl.control.law import KERNELS, LawKernel, answer
from pamctl.realtime.tick import TickSetup, TickState, step
from pamctl.signals import (
    COMPENSATION_FIELDS,
    TICK_FIELDS,
    Compensated,
    Field,
    Reference,
    Timing,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

_OF_EVERY_RUN = tuple(
    field
    for field in TICK_FIELDS
    if field.stage in ("measurement", "estimate", "command", "decision")
    or field.name == "applied_v"
)
REPLAYED_FIELDS: tuple[Field, ...] = (*_OF_EVERY_RUN, *COMPENSATION_FIELDS)
"""The fields that `replay_ticks` computes, in the order of its rows.

Those of a compensation are NaN in a run that has none.
"""
APPLIED_ROW = len(_OF_EVERY_RUN) - 1
"""The row of `applied_v`."""


class TickInputs(NamedTuple):
    """The inputs of n ticks, as columns of shape (n,): timing, raw sample, reference."""

    tick: NDArray[np.int64]
    t_s: NDArray[np.float64]
    dt_s: NDArray[np.float64]
    late_s: NDArray[np.float64]
    missed: NDArray[np.int64]
    pressure_v: NDArray[np.float64]
    encoder_counts: NDArray[np.int64]
    pressure_t_ns: NDArray[np.int64]
    encoder_t_ns: NDArray[np.int64]
    phase: NDArray[np.int64]
    reference_m: NDArray[np.float64]
    reference_velocity_m_per_s: NDArray[np.float64]
    reference_acceleration_m_per_s2: NDArray[np.float64]
    reference_jerk_m_per_s3: NDArray[np.float64]
    reference_valve_v: NDArray[np.float64]


def slice_inputs(columns: Mapping[str, NDArray[Any]], begin: int, end: int) -> TickInputs:
    """Return views of a log's columns; `begin` and `end` count ticks of the log."""
    return TickInputs._make(columns[name][begin:end] for name in TickInputs._fields)


def replay_ticks(
    setup: TickSetup,
    output: Output,
    state: TickState,
    inputs: TickInputs,
    rows: NDArray[np.float64],
) -> TickState:
    """Kernel: run n ticks; return the state after the last one.

    Fills `rows`, shape (len(REPLAYED_FIELDS), n). The reference is the logged one: if the program
    asks for another reference, that is a difference of its own, and must not hide the others.
    """
    for i in range(len(inputs.tick)):
        raw = RawSample(
            inputs.pressure_v[i],
            inputs.encoder_counts[i],
            inputs.pressure_t_ns[i],
            inputs.encoder_t_ns[i],
        )
        reference = Reference(
            inputs.phase[i],
            inputs.reference_m[i],
            inputs.reference_velocity_m_per_s[i],
            inputs.reference_acceleration_m_per_s2[i],
            inputs.reference_jerk_m_per_s3[i],
            inputs.reference_valve_v[i],
        )
        timing = Timing(
            inputs.tick[i], inputs.t_s[i], inputs.dt_s[i], inputs.late_s[i], inputs.missed[i]
        )
        state, decision = step(setup, state, raw, reference, timing)
        rows[0, i], rows[1, i] = state.measurement
        rows[2, i], rows[3, i], rows[4, i], rows[5, i], rows[6, i] = state.estimate
        rows[7, i], rows[8, i], rows[9, i], rows[10, i], rows[11, i] = state.command
        rows[12, i], rows[13, i], rows[14, i] = decision
        rows[15, i] = nearest_output_v(output, output_v(setup.calibration, decision.valve_v))
        _fill_compensated(rows, i, state.compensated)
    return state


def _fill_compensated(rows: NDArray[np.float64], i: int, compensated: Compensated | None) -> None:
    if compensated is None:
        return
    rows[16, i], rows[17, i], rows[18, i] = compensated


def replay_stretch(
    setup: TickSetup, output: Output, state: TickState, inputs: TickInputs, *, plain: bool = False
) -> tuple[TickState, NDArray[np.float64]]:
    """Run the ticks of a stretch, compiled or, as the loop process does, in plain Python.

    Returns the state after the last tick, and the rows, shape (len(REPLAYED_FIELDS), n).
    """
    rows = np.full((len(REPLAYED_FIELDS), len(inputs.tick)), np.nan)
    if plain:
        # The loop computes with Python's numbers: numpy's scalars use another library for powers.
        inputs = TickInputs._make(column.tolist() for column in inputs)
        return replay_ticks(setup, output, state, inputs, rows), rows
    return _compile_replay_ticks(KERNELS[type(setup.gains)])(
        setup, output, state, inputs, rows
    ), rows


@cache
def _compile_replay_ticks(law: LawKernel) -> Callable[..., TickState]:
    return compile_kernel(replay_ticks, (answer, law))
