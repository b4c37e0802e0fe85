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
from pamctl.log.wire import TickLayout, decode_each

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
    """Collects the messages of the tick channel, and turns them into columns."""

    def __init__(self, schema: Schema) -> None:
        """Raise UnknownLayout if the schema describes no row of numbers."""
        self._schema = schema
        self._layout = TickLayout.of_descriptor(schema.data, schema.name)
        self._fits = self._layout is not None
        self._runs: list[NDArray[Any]] = []

    def take(self, data: memoryview, first: Record) -> NDArray[Any]:
        """Take the run that begins with `first`, a record within `data`, and return it.

        Since the first begins a record and all are of its length, each begins one.
        """
        form = self._form(first.end - first.start - _BODY_AT)
        count = (len(data) - first.start) // form.itemsize
        messages = np.frombuffer(data, form, count, first.start)
        alike = np.ones(count, bool)
        for name in ("opcode", "length", "channel"):
            alike &= messages[name] == messages[name][0]
        run = messages if alike.all() else messages[: int(alike.argmin())]
        self._fits = (
            self._fits
            and self._layout is not None
            and (form["body"] == self._layout.dtype and self._layout.fits(run["body"]))
        )
        self._runs.append(run)
        return run

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return every field of the schema by name; raise UnknownLayout where one is missing."""
        if self._fits and self._layout is not None:
            return self._layout.decode(self._joined("body", self._layout.dtype))
        bodies = (body.tobytes() for run in self._runs for body in run["body"])
        return decode_each(self._schema.data, self._schema.name, bodies)

    def times(self) -> NDArray[np.uint64]:
        """Return the log time of each message, in ns."""
        return self._joined("log_time", np.dtype("<u8"))

    def _form(self, body_bytes: int) -> np.dtype[Any]:
        fixed = self._layout is not None and self._layout.dtype.itemsize == body_bytes
        body = self._layout.dtype if self._layout is not None and fixed else f"V{body_bytes}"
        return np.dtype([*MESSAGE_HEADER, ("body", body)])

    def _joined(self, name: str, form: np.dtype[Any]) -> NDArray[Any]:
        return np.concatenate([np.zeros(0, form), *(run[name] for run in self._runs)])
