"""The ticks of a log, a run of messages at a time.

Within a chunk ticks follow one another, and all have one length: such a run is
one numpy view, and there is no loop over messages. Ticks of any other form are
decoded one by one, by the descriptor that the log carries.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Schema
from numpy.typing import NDArray

from pamctl.log.framing import FileRecord
from pamctl.log.wire import TickLayout, make_decoder

MESSAGE_HEADER = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
INDEX_ENTRY = [("time", "<u8"), ("offset", "<u8")]
_BODY_AT = np.dtype(MESSAGE_HEADER).itemsize


def find_message_run(
    data: memoryview, first: FileRecord, body: np.dtype[Any] | None = None
) -> NDArray[Any]:
    """Return the messages of one channel and length that begin with a record within `data`.

    Since the first begins a record and all are of its length, each begins one.
    """
    form = np.dtype([*MESSAGE_HEADER, ("body", body or f"V{_count_body_bytes(first)}")])
    count = (len(data) - first.start) // form.itemsize
    messages = np.frombuffer(data, form, count, first.start)
    alike = np.ones(count, bool)
    for name in ("opcode", "length", "channel"):
        alike &= messages[name] == messages[name][0]
    return messages if alike.all() else messages[: int(alike.argmin())]


def _count_body_bytes(message: FileRecord) -> int:
    return message.end - message.start - _BODY_AT


class TickBatch(NamedTuple):
    """Ticks that follow one another in the file, n of them."""

    log_time_ns: NDArray[np.uint64]
    sequence: NDArray[np.uint32]
    columns: Mapping[str, NDArray[Any]]
    """Each of shape (n,), by name."""


class TickDecoder:
    """Makes columns of the messages of the tick channel."""

    def __init__(
        self,
        schema: Schema,
        take: Callable[[TickBatch], None] | None,
        fields: Collection[str] | None = None,
    ) -> None:
        """`take` gets each batch, with these fields or all; without it ticks are only counted.

        Raise UnknownLayout if the schema describes no row of numbers.
        """
        self._layout = TickLayout.of_descriptor(schema.data, schema.name)
        self._decode = make_decoder(schema.data, schema.name)
        self._take = take
        self._fields = fields
        self.none = self._decode([])
        """Every column of no tick at all, each of its type."""

    def run(self, data: memoryview, first: FileRecord) -> tuple[int, int]:
        """Decode the run that begins with `first`, a record within `data`; return its ticks, end.

        Raise UnknownLayout where a tick lacks an integer.
        """
        messages = find_message_run(data, first, self._body(_count_body_bytes(first)))
        if self._take is not None:
            columns = self._decode_messages(messages)
            self._take(TickBatch(messages["log_time"].copy(), messages["sequence"].copy(), columns))
        return len(messages), first.start + messages.nbytes

    def _body(self, size: int) -> np.dtype[Any] | None:
        fixed = self._layout is not None and self._layout.dtype.itemsize == size
        return self._layout.dtype if self._layout is not None and fixed else None

    def _decode_messages(self, messages: NDArray[Any]) -> dict[str, NDArray[Any]]:
        layout, bodies = self._layout, messages["body"]
        if layout is not None and bodies.dtype == layout.dtype:
            octets = messages.view(np.uint8).reshape(len(messages), messages.itemsize)
            if layout.fits(octets[:, _BODY_AT:]):
                return layout.decode(bodies, self._fields)
        return self._select_fields(self._decode(body.tobytes() for body in bodies))

    def _select_fields(self, columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        if self._fields is None:
            return columns
        return {name: column for name, column in columns.items() if name in self._fields}


def suggest_nearest(name: str, columns: Collection[str]) -> str:
    """Return the hint at the name that was probably meant, nothing if none is near."""
    near = difflib.get_close_matches(name, columns, 1)
    return f"; did you mean {near[0]}?" if near else ""


_FOLD_TICKS = 1 << 16
"""So many ticks of a column are half a megabyte: freed, they go back to the system."""


class TickColumns:
    """Collects batches as whole columns."""

    def __init__(self) -> None:
        self._times: list[NDArray[np.uint64]] = [np.zeros(0, np.uint64)]
        self._columns: dict[str, list[NDArray[Any]]] = {}
        self._fresh: list[TickBatch] = []
        self._fresh_ticks = 0

    def take(self, batch: TickBatch) -> None:
        """Add a batch."""
        self._fresh.append(batch)
        self._fresh_ticks += len(batch.sequence)
        if self._fresh_ticks >= _FOLD_TICKS:
            self._fold()

    def _fold(self) -> None:
        """Make blocks of the many small arrays, which would leave the memory in crumbs."""
        if not self._fresh:
            return
        self._times.append(np.concatenate([batch.log_time_ns for batch in self._fresh]))
        for name in self._fresh[0].columns:
            block = np.concatenate([batch.columns[name] for batch in self._fresh])
            self._columns.setdefault(name, []).append(block)
        self._fresh, self._fresh_ticks = [], 0

    def times(self) -> NDArray[np.uint64]:
        """Return the log time of each tick, in ns."""
        self._fold()
        return np.concatenate(self._times)

    def columns(self, none: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Give the columns named in `none` away; as they are there, if there was no batch.

        A column's parts go as soon as it is whole: an hour's ticks are a gigabyte once, not twice.
        """
        self._fold()
        return {
            name: np.concatenate([empty, *self._columns.pop(name, [])])
            for name, empty in none.items()
        }
