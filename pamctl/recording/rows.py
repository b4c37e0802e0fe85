"""Turn the ring's rows into the log's messages; ticks are converted by columns."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.json_text import from_json, to_json
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import EVENT_TOPIC, GAINS_TOPIC, KEYFRAME_TOPIC, TICK_TOPIC
from pamctl.log.wire import TickLayout, make_message_record, make_message_records
from pamctl.log.writer import LogWriter, begin_log
from pamctl.recording.ring import ROW_BYTES, ROW_HEADER, Entry, RowBatch, RowKind
from pamctl.signals import Field

_TOPICS = {
    RowKind.EVENT: EVENT_TOPIC,
    RowKind.GAINS: GAINS_TOPIC,
    RowKind.KEYFRAME: KEYFRAME_TOPIC,
}
_NUMPY_TYPES = {int: "<i8", float: "<f8", bool: "?"}


class RowLogger:
    """Writes batches of a run's rows into its log."""

    def __init__(self, writer: LogWriter, meta: RunMeta) -> None:
        """Begin the log."""
        self._writer = writer
        self._meta = meta
        self._layout = TickLayout.of_fields(meta.tick_fields)
        self._row = row_dtype(meta.tick_fields)
        self._channels = begin_log(writer, meta)
        self.last_tick = -(1 << 62)
        """Ticks up to this one are already in the log, and are left out."""
        self.last_row = -1
        """The same as `last_tick`, for all other rows."""
        self.written: Counter[str] = Counter()
        """Number of messages, by topic."""

    def write(self, batch: RowBatch) -> None:
        """Add a batch as one chunk, in the order in which it was put."""
        rows = np.frombuffer(batch.data, self._row)
        start = 0
        for index in np.flatnonzero(rows["kind"] != RowKind.TICK).tolist():
            self._write_ticks(rows[start:index])
            start = index + 1
            if rows["kind"][index] != RowKind.CONTINUATION:
                self._write_entry(batch.entry(index))
        self._write_ticks(rows[start:])
        self._writer.end_chunk()

    def _write_ticks(self, rows: NDArray[Any]) -> None:
        is_new = rows["tick"] > self.last_tick
        rows = rows if is_new.all() else rows[is_new]
        messages = make_message_records(
            self._layout.encode(rows["columns"]),
            np.maximum(rows["t_ns"] + self._wall_less_mono, 0),
            rows["tick"],
        )
        self._writer.add(self._channels[TICK_TOPIC], messages)
        self.written[TICK_TOPIC] += len(rows)

    def _write_entry(self, entry: Entry) -> None:
        if entry.row <= self.last_row:
            return
        value = self._decode_entry(entry)
        if value.get("event") in _METADATA_EVENTS:
            self._writer.metadata(value["event"], _values_to_text(value))
        where = {"tick": entry.tick, "t_ns": entry.t_ns, "row": entry.row}
        time = max(entry.t_ns + self._wall_less_mono, 0)
        topic = _TOPICS[entry.kind]
        message = make_message_record(to_json({**value, **where}), time, entry.tick)
        self._writer.add(self._channels[topic], message)
        self.written[topic] += 1

    def _decode_entry(self, entry: Entry) -> dict[str, Any]:
        if entry.kind != RowKind.KEYFRAME:
            return dict(from_json(entry.payload))
        state = struct.unpack(f"<{len(entry.payload) // 8}d", entry.payload)
        return {"state": dict(zip(self._meta.keyframe_fields, state, strict=True))}

    @property
    def _wall_less_mono(self) -> int:
        return self._meta.start_wall_ns - self._meta.start_mono_ns


_METADATA_EVENTS = ("timing_setup", "rig")
"""Events at the start of the loop that describe the whole run: they become metadata too."""


def _values_to_text(value: Mapping[str, object]) -> dict[str, str]:
    return {
        name: part if isinstance(part, str) else to_json(part).decode()
        for name, part in value.items()
        if name != "event"
    }


def row_dtype(fields: Sequence[Field], stride_bytes: int | None = ROW_BYTES) -> np.dtype[Any]:
    """Return the layout of a row: `kind`, `tick`, `t_ns`, and in `columns` a tick's fields.

    Rows without a stride are one behind the other.
    """
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
