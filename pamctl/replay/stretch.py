"""Run the ticks of a stretch of a log: the same function that the loop process calls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hal.converter import Output
from pamctl.kernel.calls import PlainCall, recall
from pamctl.realtime.run_ticks import NOWHERE, Guide, LoggedRig, Nothing, run_ticks, start_loop
from pamctl.realtime.tick import TickSetup, TickState
from pamctl.realtime.tick_runner import UPDATES
from pamctl.recording.rows import make_rows, row_dtype
from pamctl.signals import COMPENSATION_FIELDS, TICK_FIELDS, Field, Reference, list_tick_fields

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


_OF_RIG = LoggedRig._fields[:-1]
REPLAY_INPUTS = (*_OF_RIG, *Reference._fields)
"""The columns that a replay takes from the log: timing, raw sample, and reference."""


def replay_stretch(
    setup: TickSetup,
    output: Output,
    state: TickState,
    inputs: Mapping[str, NDArray[Any]],
    *,
    plain: bool = False,
) -> tuple[TickState, NDArray[np.float64]]:
    """Run the ticks of a stretch as machine code or, as the reference, in plain Python.

    `inputs` has the columns `REPLAY_INPUTS`, each of shape (n,). Returns the state after the last
    tick, and the rows, shape (len(REPLAYED_FIELDS), n). The reference is the logged one: if the
    program asks for another reference, that is a difference of its own, and must not hide the
    others.
    """
    n, compensates = len(inputs["tick"]), setup.compensation is not None
    columns: list[Any] = [np.ascontiguousarray(inputs[name]) for name in _OF_RIG]
    table = np.column_stack([inputs[name] for name in Reference._fields]).ravel()
    buffer = make_rows(compensates, n, None)
    arguments = {
        "setup": setup,
        "loop": start_loop(state, 0, 0),
        "rig": LoggedRig._make([*columns, output]),
        "inner": Nothing(),
        "outer": Nothing(),
        "guide": Guide(NOWHERE, table, True),
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
