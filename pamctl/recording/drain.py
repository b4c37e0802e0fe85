"""Write the ring's rows into the log, until the run is over.

The ring's tail moves only when a chunk is in the file. If this process dies before that, the rows
are still in the ring, and `finish_from_ring.py` writes them.
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from io import BufferedWriter
from pathlib import Path
from time import monotonic
from typing import Protocol

from pamctl.log.framing import LogError
from pamctl.log.writer import LogWriter
from pamctl.recording.disk_space import Reserve, is_full
from pamctl.recording.ring import ROW_BYTES, RecorderFlag, Ring
from pamctl.recording.rows import RowLogger

ROUND_S = 0.05
CHUNK_ROWS = 250
"""Rows of a chunk, unless `CHUNK_S` passes first; small chunks compress badly."""
CHUNK_S = 0.5
MAX_CHUNK_ROWS = 2048
SYNC_S = 1.0
STALLED_S = 1.0
"""A loop without a sign of life for this time, whose owner is gone, counts as dead."""

_MESSAGE_BYTES = 31 + 16
"""Bytes of a message beside its payload: frame and index entry."""


class Owner(Protocol):
    """The process that started the recorder."""

    def wait(self, seconds: float) -> None:
        """Sleep, but wake up when the owner ends."""

    @property
    def gone(self) -> bool:
        """Whether the owner has ended."""


def record_run(ring: Ring, owner: Owner) -> bool:
    """Write the whole log of a run; return False if the disk was too small for it.

    Raise LogError if the log cannot be created, OSError if writing fails. In both cases the rows
    that are not in the file are still in the ring.
    """
    path = Path(ring.meta.log_path)
    with _create_log(path) as file:
        reserve = _reserve_space(ring, file, path)
        ring.log_inode = os.fstat(file.fileno()).st_ino
        recording = _Recording(ring, file, reserve)
        ring.raise_flag(RecorderFlag.READY)
        loop = _SignsOfLife(ring)
        while not (ring.loop_done or (owner.gone and loop.has_ceased())):
            recording.round()
            if not recording.is_behind:
                owner.wait(ROUND_S)
        recording.finish()
    return not ring.recorder_flags & RecorderFlag.DISK_FULL


def _create_log(path: Path) -> BufferedWriter:
    try:
        return path.open("xb")
    except FileExistsError:
        raise LogError(
            f"{path} exists, and a log is never overwritten; give --log another name"
        ) from None
    except OSError as error:
        raise LogError(
            f"cannot create the log {path}: {error.strerror}; give --log another place"
        ) from error


def _reserve_space(ring: Ring, file: BufferedWriter, path: Path) -> Reserve:
    reserve = Reserve(file.fileno(), ring.rows * (ROW_BYTES + _MESSAGE_BYTES))
    try:
        reserve.extend(0, 0)
    except OSError as error:
        path.unlink()
        if is_full(error):
            ring.raise_flag(RecorderFlag.DISK_FULL)
        raise LogError(
            f"no room for a log at {path}: {error.strerror}; "
            "free some space, or give --log another place"
        ) from error
    if not reserve.supported:
        print(f"recorder: note: the file system of {path} cannot reserve space", file=sys.stderr)
    return reserve


class _SignsOfLife:
    """Watches the loop through the ring, without a common clock.

    If the whole machine stood still, the loop is not dead: at most two rounds are counted between
    two looks.
    """

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._last = (-1, -1)
        self._looked_s = monotonic()
        self._silent_s = 0.0

    def has_ceased(self) -> bool:
        now_s, sign = monotonic(), (self._ring.head, self._ring.loop_beat_ns)
        self._silent_s += min(now_s - self._looked_s, 2.0 * ROUND_S)
        self._looked_s = now_s
        if sign != self._last:
            self._last, self._silent_s = sign, 0.0
        return self._silent_s > STALLED_S


class _Recording:
    """Writes the log, chunk by chunk."""

    def __init__(self, ring: Ring, file: BufferedWriter, reserve: Reserve) -> None:
        self._ring = ring
        self._file = file
        self._reserve = reserve
        self._writer = LogWriter(file)
        self._rows = RowLogger(self._writer, ring.meta)
        self._file.flush()
        self._full = False
        # A slow disk may take seconds. Meanwhile the ring must be emptied and beats must go on.
        self._syncing = ThreadPoolExecutor(1)
        self._sync = self._syncing.submit(os.fdatasync, file.fileno())
        self._chunk_at = self._synced_at = monotonic()
        # A small ring must be emptied before it holds the preferred number of rows.
        self._least = min(CHUNK_ROWS, ring.rows // 8)
        self._most = min(MAX_CHUNK_ROWS, ring.rows // 4)

    @property
    def is_behind(self) -> bool:
        """Whether a full chunk is waiting."""
        return self._ring.pending >= self._most

    def round(self) -> None:
        """Write a chunk if one is due, and beat."""
        self._ring.recorder_beats += 1
        now = monotonic()
        pending = self._ring.pending
        if pending >= self._least or (pending and now - self._chunk_at >= CHUNK_S):
            self._write_chunk()
            self._chunk_at = now
        if now - self._synced_at >= SYNC_S and self._sync.done():
            self._sync.result()
            self._sync = self._syncing.submit(os.fdatasync, self._file.fileno())
            self._synced_at = now

    def finish(self) -> None:
        """Write the remaining rows, the index and the footer; return when they are on the disk."""
        while self._ring.pending:
            self._ring.recorder_beats += 1
            self._write_chunk()
        self._syncing.shutdown()
        # A failed write-back is reported only once: here, or in the fsync below.
        self._sync.result()
        self._writer.finish()
        self._file.flush()
        self._reserve.release(self._file.tell())
        os.fsync(self._file.fileno())
        self._ring.raise_flag(RecorderFlag.FINISHED)

    def _write_chunk(self) -> None:
        self._extend_reserve()
        batch = self._ring.drain(self._most)
        self._rows.write(batch)
        self._ring.commit(batch.end_row)

    def _extend_reserve(self) -> None:
        if self._full:
            return
        try:
            self._reserve.extend(self._file.tell(), self._writer.chunks)
        except OSError as error:
            if not is_full(error):
                raise
            # The loop stops on this flag; until then its rows go into the reserve.
            self._full = True
            self._ring.raise_flag(RecorderFlag.DISK_FULL)
