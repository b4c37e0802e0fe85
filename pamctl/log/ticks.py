"""Decode the ticks of a log, many messages at a time.

Ticks of equal length that follow one another in a chunk are one numpy view, without a loop over
messages. Ticks of any other form are decoded one by one, by the descriptor that the log carries.
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
    """Return the messages from `first` on that have its channel and its length.

    They follow one another in `data` without another record between them.
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
    """n ticks that follow one another in the file."""

    log_time_ns: NDArray[np.uint64]
    sequence: NDArray[np.uint32]
    columns: Mapping[str, NDArray[Any]]
    """Columns by name, each of shape (n,)."""


class TickDecoder:
    """Decodes messages of the tick channel into columns."""

    def __init__(
        self,
        schema: Schema,
        take: Callable[[TickBatch], None] | None,
        fields: Collection[str] | None = None,
    ) -> None:
        """`take` gets each batch with these fields (default: all); without it ticks are counted.

        Raise UnknownLayout if the schema does not describe a row of numbers.
        """
        self._layout = TickLayout.of_descriptor(schema.data, schema.name)
        self._decode = make_decoder(schema.data, schema.name)
        self._take = take
        self._fields = fields
        self.none = self._decode([])
        """Empty columns, each of its type."""

    def run(self, data: memoryview, first: FileRecord) -> tuple[int, int]:
        """Decode the ticks from the record `first` of `data` on; return their number and their end.

        Raise UnknownLayout if a tick lacks an integer.
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
    """Return a hint with the nearest name, an empty text if none is near."""
    near = difflib.get_close_matches(name, columns, 1)
    return f"; did you mean {near[0]}?" if near else ""


_FOLD_TICKS = 1 << 16
"""Ticks per block: half a megabyte a column, which returns to the system when freed."""


class TickColumns:
    """Collects batches into whole columns."""

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
        """Join the many small arrays into blocks: small arrays would fragment the memory."""
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
        """Return the columns named in `none`, and forget them; `none` gives type and empty value.

        The parts of a column are freed as soon as it is joined: an hour's ticks take a gigabyte
        once, not twice.
        """
        self._fold()
        return {
            name: np.concatenate([empty, *self._columns.pop(name, [])])
            for name, empty in none.items()
        }
