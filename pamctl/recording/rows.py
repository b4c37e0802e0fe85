"""A row of the ring: what it holds, how a tick is packed into it, and how it is read again.

Rows are little-endian and 512 bytes long. A payload that is longer goes on in the rows behind it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from pamctl.kernel.layout import Rows
from pamctl.signals import COMPENSATION_FIELDS, TICK_FIELDS, Field, TickRecord, make_empty_record

if TYPE_CHECKING:
    import numpy as np

ROW_BYTES = 512
ROW_HEADER = struct.Struct("<IIqq")
"""Kind, payload bytes (of all rows that it spans), tick, monotonic time (ns)."""
PAYLOAD_BYTES = ROW_BYTES - ROW_HEADER.size
_CODES = {int: "q", float: "d", bool: "?7x"}
"""Each fills 8 bytes: a row is what a kernel has in memory (`pamctl.kernel.layout`)."""
_NUMPY_TYPES = {int: "<i8", float: "<f8", bool: "?"}


class RowKind:
    """The content of a row."""

    TICK = 1
    EVENT = 2
    GAINS = 3
    KEYFRAME = 4
    CONTINUATION = 5


class Entry(NamedTuple):
    """One entry: `payload` is a tick row's packed columns, JSON, or doubles."""

    row: int
    kind: int
    tick: int
    t_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class RowBatch:
    """Rows copied out of the ring; it never ends within an entry."""

    first_row: int
    """Number of rows put before this one."""
    data: bytes

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.data) // ROW_BYTES

    @property
    def end_row(self) -> int:
        """The argument of `commit` once these rows are in the log."""
        return self.first_row + self.rows

    def entry(self, index: int) -> Entry:
        """Return the entry that begins at row `index` of this batch."""
        kind, size, tick, t_ns = ROW_HEADER.unpack_from(self.data, index * ROW_BYTES)
        span = range(index, index + count_rows(size))
        pieces = (self.data[at * ROW_BYTES + ROW_HEADER.size : (at + 1) * ROW_BYTES] for at in span)
        return Entry(self.first_row + index, kind, tick, t_ns, b"".join(pieces)[:size])

    def entries(self) -> Iterator[Entry]:
        """Yield all entries."""
        index = 0
        while index < self.rows:
            entry = self.entry(index)
            yield entry
            index += count_rows(len(entry.payload))


def count_rows(size: int) -> int:
    """Return how many rows a payload of so many bytes spans."""
    return max(1, -(-size // PAYLOAD_BYTES))


def tick_struct(fields: Sequence[Field]) -> struct.Struct:
    """Return the packing of a tick's columns, each in 8 bytes."""
    return struct.Struct("<" + "".join(_CODES[field.kind] for field in fields))


def row_dtype(fields: Sequence[Field], stride_bytes: int | None = ROW_BYTES) -> np.dtype[Any]:
    """Return the layout of a row: `kind`, `tick`, `t_ns`, and in `columns` a tick's fields.

    Rows without a stride are one behind the other.
    """
    import numpy as np  # the loop does without

    columns = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [_NUMPY_TYPES[field.kind] for field in fields],
            "offsets": [8 * at for at in range(len(fields))],
            "itemsize": 8 * len(fields),
        }
    )
    return np.dtype(
        {
            "names": ["kind", "tick", "t_ns", "columns"],
            "formats": ["<u4", "<i8", "<i8", columns],
            "offsets": [0, 8, 16, ROW_HEADER.size],
            "itemsize": stride_bytes or ROW_HEADER.size + columns.itemsize,
        }
    )


class TickRow(NamedTuple):
    """A row with a tick, as a kernel sets it."""

    kind_and_bytes: int
    """`PLAIN_TICK` or `COMPENSATED_TICK`."""
    tick: int
    t_ns: int
    record: TickRecord


def make_rows(compensates: bool, count: int, stride_bytes: int | None = ROW_BYTES) -> Rows[TickRow]:
    """Return rows of ticks that a kernel can set, by default as wide as those of the ring.

    None: one behind the other.
    """
    return Rows(TickRow(0, 0, 0, make_empty_record(compensates)), count, stride_bytes)


def _pack_kind(fields: Sequence[Field]) -> int:
    return RowKind.TICK | tick_struct(fields).size << 32


PLAIN_TICK = _pack_kind(TICK_FIELDS)
COMPENSATED_TICK = _pack_kind((*TICK_FIELDS, *COMPENSATION_FIELDS))
"""Kind and size of the row of a tick, in a run that compensates."""
