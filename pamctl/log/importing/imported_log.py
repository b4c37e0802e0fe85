"""Write a measurement of another system as a log: the same message with fewer columns.

That system's clock and controller are unknown. The log's wall time starts at zero, its
configuration is empty, and its metadata states the source.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.log.record_problems import nominal_period_s
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import IMPORTED, TICK_TOPIC, imported_fields
from pamctl.log.wire import TickLayout, make_message_records
from pamctl.log.writer import LogWriter, begin_log
from pamctl.new_file import create_new_file

CHUNK_TICKS = 2048

Floats = NDArray[np.float64]


def write_imported(
    path: str | Path, t_s: Floats, quantities: Mapping[str, Floats], story: Mapping[str, str]
) -> None:
    """Write a measurement into a new file.

    `t_s`, shape (n,) with n > 1, rises strictly from zero. `quantities` holds arrays of shape (n,)
    by their names in `IMPORTED_QUANTITIES`. `story` becomes the metadata record `import`.
    Raise NewFileError if it cannot be written.
    """
    fields = imported_fields(quantities)
    layout = TickLayout.of_fields(fields)
    messages = layout.encode(_build_table(t_s, quantities, layout))
    meta = RunMeta(
        str(path),
        metadata={"run": {"backend": IMPORTED}, "import": story},
        tick_fields=fields,
        origin=IMPORTED,
    )
    with create_new_file(Path(path)) as stream:
        writer = LogWriter(stream)
        channel = begin_log(writer, meta)[TICK_TOPIC]
        for start in range(0, len(t_s), CHUNK_TICKS):
            part = messages[start : start + CHUNK_TICKS]
            times_ns = np.rint(part["t_s"] * 1e9).astype(np.int64)
            writer.add(channel, make_message_records(part, times_ns, part["tick"]))
            writer.end_chunk()
        writer.finish()


def _build_table(t_s: Floats, quantities: Mapping[str, Floats], layout: TickLayout) -> NDArray[Any]:
    """Return the columns of the log as one structured array."""
    period_s = nominal_period_s(t_s)
    steps = np.maximum(1, np.rint(np.diff(t_s) / period_s)).astype(np.int64)
    columns = {
        "tick": np.concatenate(([0], np.cumsum(steps))),
        "t_s": t_s,
        "dt_s": np.concatenate(([period_s], np.diff(t_s))),
        "missed": np.concatenate(([0], steps - 1)),
        **quantities,
    }
    table = np.zeros(len(t_s), layout.dtype)
    for name in layout.names:
        table[name] = columns[name]
    return table
