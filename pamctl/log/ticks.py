"""The ticks of a log, a run of messages at a time.

Within a chunk ticks follow one another, and all have one length: such a run is
one numpy view, and there is no loop over messages. Ticks of any other form are
decoded one by one, by the descriptor that the log carries.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mcap.records import Schema
from numpy.typing import NDArray

from pamctl.log.records import Record
from pamctl.log.wire import TickLayout, one_by_one

MESSAGE_HEADER = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
_BODY_AT = np.dtype(MESSAGE_HEADER).itemsize


class TickRuns:
    """Collects the messages of the tick channel as columns."""

    def __init__(self, schema: Schema) -> None:
        """Raise UnknownLayout if the schema describes no row of numbers."""
        self._layout = TickLayout.of_descriptor(schema.data, schema.name)
        self._decode = one_by_one(schema.data, schema.name)
        self._times: list[NDArray[np.uint64]] = [np.zeros(0, np.uint64)]
        self._columns = [self._decode([])]

    def take(self, data: memoryview, first: Record, *, keep: bool) -> tuple[int, int]:
        """Take the run that begins with `first`, a record within `data`; return its ticks and end.

        Since the first begins a record and all are of its length, each begins one.
        Raise UnknownLayout where a tick lacks an integer. Not to `keep` is to count only.
        """
        form = self._form(first.end - first.start - _BODY_AT)
        count = (len(data) - first.start) // form.itemsize
        messages = np.frombuffer(data, form, count, first.start)
        alike = np.ones(count, bool)
        for name in ("opcode", "length", "channel"):
            alike &= messages[name] == messages[name][0]
        run = messages if alike.all() else messages[: int(alike.argmin())]
        if keep:
            self._times.append(run["log_time"].copy())
            self._columns.append(self._decoded(run["body"]))
        return len(run), first.start + run.nbytes

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return every field of the schema by name."""
        names = self._columns[0]
        return {name: np.concatenate([run[name] for run in self._columns]) for name in names}

    def times(self) -> NDArray[np.uint64]:
        """Return the log time of each message, in ns."""
        return np.concatenate(self._times)

    def _form(self, body_bytes: int) -> np.dtype[Any]:
        fixed = self._layout is not None and self._layout.dtype.itemsize == body_bytes
        body = self._layout.dtype if self._layout is not None and fixed else f"V{body_bytes}"
        return np.dtype([*MESSAGE_HEADER, ("body", body)])

    def _decoded(self, bodies: NDArray[Any]) -> dict[str, NDArray[Any]]:
        layout = self._layout
        if layout is not None and bodies.dtype == layout.dtype and layout.fits(bodies):
            return layout.decode(bodies)
        return self._decode(body.tobytes() for body in bodies)
