"""Rows straight into the log, without a ring: for a run in one process."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence

from pamctl.json_text import to_json
from pamctl.log.run_meta import RunMeta
from pamctl.recording.drain import RowLogger
from pamctl.recording.rows import (
    PAYLOAD_BYTES,
    ROW_BYTES,
    ROW_HEADER,
    RowBatch,
    RowKind,
    tick_struct,
)

CHUNK_ROWS = 2048


class LogJournal:
    """Collects the rows of a chunk as a ring has them, and writes each chunk when it is full."""

    def __init__(
        self, rows: RowLogger, meta: RunMeta, tell: Callable[[Mapping[str, float]], None]
    ) -> None:
        """`tell` is called with the newest tick's columns after each chunk."""
        self._rows = rows
        self._meta = meta
        self._tell = tell
        self._tick = tick_struct(meta.tick_fields)
        self._keyframe = struct.Struct(f"<{len(meta.keyframe_fields)}d")
        self._kept = bytearray()
        self._first_row = 0
        self._last = (0, meta.start_mono_ns)

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        """Keep a tick that is packed already as a row of a ring."""
        self.put_rows(memoryview(row))

    def put_rows(self, rows: memoryview) -> None:
        """Keep ticks that are packed already as rows of a ring."""
        _, _, tick, t_ns = ROW_HEADER.unpack_from(rows, len(rows) - ROW_BYTES)
        self._last = (tick, t_ns)
        self._kept += rows
        if len(self._kept) >= CHUNK_ROWS * ROW_BYTES:
            newest = bytes(rows[-ROW_BYTES:])
            self.write_chunk()
            names = (field.name for field in self._meta.tick_fields)
            columns = self._tick.unpack_from(newest, ROW_HEADER.size)
            self._tell(dict(zip(names, columns, strict=True)))

    def rehearse_row(self, row: bytearray) -> None:
        """Do nothing: without a clock there is no rehearsal."""

    @property
    def start_ns(self) -> int:
        """When the run began, on its own clock."""
        return self._meta.start_mono_ns

    def note_start(self, event: Mapping[str, object]) -> None:
        """Keep an event before the rig is open."""
        self.put_event(0, self.start_ns, event)

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Keep an event; its key `event` names it."""
        self._put(RowKind.EVENT, tick, t_ns, to_json(event))

    def put_last_event(self, event: Mapping[str, object]) -> None:
        """Keep an event at the time of the last tick."""
        self.put_event(*self._last, event)

    def put_gains(self, tick: int, t_ns: int, gains: Mapping[str, object]) -> None:
        """Keep gains that apply from this tick on."""
        self._put(RowKind.GAINS, tick, t_ns, to_json(gains))

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Keep the frozen state."""
        self._put(RowKind.KEYFRAME, tick, t_ns, self._keyframe.pack(*state))

    def end_ticks(self) -> None:
        """Do nothing: nobody else watches this run."""

    def write_chunk(self) -> None:
        """Write the rows that are kept."""
        if self._kept:
            batch = RowBatch(self._first_row, bytes(self._kept))
            self._rows.write(batch)
            self._first_row = batch.end_row
            self._kept.clear()

    def _put(self, kind: int, tick: int, t_ns: int, payload: bytes) -> None:
        for at in range(0, max(1, len(payload)), PAYLOAD_BYTES):
            piece = payload[at : at + PAYLOAD_BYTES]
            self._kept += _pack_row(kind, tick, t_ns, len(payload), piece)
            kind = RowKind.CONTINUATION


def _pack_row(kind: int, tick: int, t_ns: int, size: int, piece: bytes) -> bytes:
    return (ROW_HEADER.pack(kind, size, tick, t_ns) + piece).ljust(ROW_BYTES, b"\0")
