"""Run the ticks of a stretch of a log: the same function that the loop process calls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hal.converter import Output
from pamctl.kernel.calls import PlainCall, recall
from pamctl.realtime.run_ticks import LoggedRig, Nothing, TableGuide, run_ticks, start_loop
from pamctl.realtime.tick import TickSetup, TickState
from pamctl.realtime.tick_runner import UPDATES
from pamctl.recording.ring import make_rows
from pamctl.recording.rows import row_dtype
from pamctl.signals import COMPENSATION_FIELDS, TICK_FIELDS, Field, list_tick_fields

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

_OF_EVERY_RUN = tuple(
    field
    for field in TICK_FIELDS
    if field.stage in ("measurement", "estimate", "command", "decision")
    or field.name == "applied_v"
)
REPLAYED_FIELDS: tuple[Field, ...] = (*_OF_EVERY_RUN, *COMPENSATION_FIELDS)
"""The fields that `replay_stretch` computes, in the order of its rows.

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


_OF_RIG = len(LoggedRig._fields) - 1


def replay_stretch(
    setup: TickSetup, output: Output, state: TickState, inputs: TickInputs, *, plain: bool = False
) -> tuple[TickState, NDArray[np.float64]]:
    """Run the ticks of a stretch as machine code or, as the reference, in plain Python.

    Returns the state after the last tick, and the rows, shape (len(REPLAYED_FIELDS), n). The
    reference is the logged one: if the program asks for another reference, that is a difference of
    its own, and must not hide the others.
    """
    n, compensates = len(inputs.tick), setup.compensation is not None
    # Plain Python computes with its own numbers: those of numpy use another library for powers.
    columns: list[Any] = [
        column.tolist() if plain else np.ascontiguousarray(column) for column in inputs
    ]
    buffer = make_rows(compensates, n, None)
    arguments = {
        "setup": setup,
        "loop": start_loop(state, 0, 0),
        "rig": LoggedRig._make([*columns[:_OF_RIG], output]),
        "inner": Nothing(),
        "outer": Nothing(),
        "guide": TableGuide._make(columns[_OF_RIG:]),
        "rows": buffer,
        "n": n,
    }
    call = (PlainCall if plain else recall)(run_ticks, arguments, UPDATES)
    call.run()
    rows = np.full((len(REPLAYED_FIELDS), n), np.nan)
    ticks: Any = np.frombuffer(buffer.buffer, row_dtype(list_tick_fields(compensates), None))[
        "columns"
    ]
    for row, field in zip(rows, REPLAYED_FIELDS, strict=True):
        if field.name in ticks.dtype.names:
            row[:] = ticks[field.name]
    return call.get("loop").state, rows
