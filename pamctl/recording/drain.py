"""Write the ring's rows into the log, until the run is over.

The ring's tail moves only when a chunk is in the file. If this process dies before that, the rows
are still in the ring, and the next recorder goes on behind the last whole chunk of the file. Ticks
are converted by columns.

Disk space is reserved ahead: blocks after the end of the file are allocated before they are needed.
When the disk is full, there is still room for all rows in the ring, the index and the footer.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
import sys
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from io import BufferedRandom
from itertools import chain, count
from pathlib import Path
from time import monotonic, monotonic_ns
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pamctl.base.texts import from_json, to_json
from pamctl.log.framing import Damage, LogError
from pamctl.log.recover import Recovery, recover_file, resume_log, sign_recovery
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import EVENT_TOPIC, GAINS_TOPIC, KEYFRAME_TOPIC, TICK_TOPIC
from pamctl.log.wire import TickLayout, make_message_record, make_message_records
from pamctl.log.writer import LogWriter, begin_log
from pamctl.recording.journal import StandStill
from pamctl.recording.ring import LOOP_DEAD_NS, RecorderFlag, Ring
from pamctl.recording.rows import ROW_BYTES, Entry, RowBatch, RowKind, row_dtype

ROUND_S = 0.05
CHUNK_ROWS = 250
"""Rows of a chunk, unless `CHUNK_S` passes first; small chunks compress badly."""
CHUNK_S = 0.5
MAX_CHUNK_ROWS = 2048
SYNC_S = 1.0
STALLED_S = 1.0
"""A loop without a sign of life for this time, whose owner is gone, counts as dead."""

_sync_data = getattr(os, "fdatasync", os.fsync)  # other systems know only the whole

_MESSAGE_BYTES = 31 + 16
"""Bytes of a message beside its payload: frame and index entry."""


class Owner(Protocol):
    """The process that started the recorder."""

    def wait(self, seconds: float) -> object:
        """Sleep, but wake up when the owner ends."""

    @property
    def gone(self) -> bool:
        """Whether the owner has ended."""


def record_run(ring: Ring, owner: Owner) -> bool:
    """Write the log of a run to its end; return False if the disk was too small for it.

    It goes on with the file of a recorder that has died. Raise LogError if the log cannot be
    created, OSError if writing fails. In both cases the rows that are not in the file are still in
    the ring.
    """
    try:
        return _record_to_end(ring, owner)
    except Damage:
        _repair(ring)
        return _record_to_end(ring, owner)


def _record_to_end(ring: Ring, owner: Owner) -> bool:
    path, is_new = _find_log(ring, owner)
    with _create_log(path) if is_new else path.open("r+b") as file:
        reserve = _reserve_space(ring, file, path, is_new=is_new)
        ring.log_inode = os.fstat(file.fileno()).st_ino
        recording = _Recording(ring, file, reserve, _begin(ring, path, file, is_new=is_new))
        ring.raise_flag(RecorderFlag.READY)
        # A loop that was silent for long before this process began is dead.
        is_silent = monotonic_ns() - ring.loop_beat_ns > LOOP_DEAD_NS
        loop = StandStill(
            lambda: (ring.head, ring.loop_beat_ns), 2.0 * ROUND_S, 2.0 * STALLED_S * is_silent
        )
        while not (ring.loop_done or (owner.gone and loop.lasts_s() > STALLED_S)):
            recording.round()
            if not recording.is_behind:
                owner.wait(ROUND_S)
        recording.finish()
    return not ring.recorder_flags & RecorderFlag.DISK_FULL


def _find_log(ring: Ring, owner: Owner) -> tuple[Path, bool]:
    """Return where the log of a ring is written, and whether the file is still to be made.

    If the file that the ring's recorder had begun is not there any more, or another one is in its
    place, a new one takes the rows that are left.
    """
    path = Path(ring.meta.log_path)
    inode = path.stat().st_ino if path.exists() else 0
    if inode and inode in (ring.log_inode, ring.mended_inode):
        # `mended_inode` is wanted for a repair that is to come: until then this file is ours.
        ring.log_inode = inode
        return path, False
    if not ring.log_inode and not (inode and owner.gone):
        return path, True
    if inode or ring.tail:
        ring.raise_flag(RecorderFlag.GAPS)
    others = (path.with_stem(f"{path.stem}-recovered-{number}") for number in count(2))
    names = chain((path, path.with_stem(f"{path.stem}-recovered")), others)
    return next(name for name in names if not name.exists()), True


def _begin(ring: Ring, path: Path, file: BufferedRandom, *, is_new: bool) -> RowLogger:
    """Begin the log, or take it up behind its last whole chunk."""
    if is_new:
        return RowLogger(LogWriter(file), ring.meta)

    def beat() -> None:
        ring.recorder_beats += 1

    log = resume_log(path, file, beat)
    rows = RowLogger(log.writer, ring.meta)
    rows.last_tick, rows.last_row = log.last_tick, log.last_row
    source = f"{path} and {ring.path}"
    if log.damage:
        sign_recovery(log.writer, Recovery(source, str(path), {}, (log.damage,), True, 0))
    return rows


def _repair(ring: Ring) -> None:
    """Leave what is damaged within the file out of it; the file is exchanged in one step."""
    ring.raise_flag(RecorderFlag.GAPS)
    path = Path(ring.meta.log_path)
    draft = path.with_name(f"{path.name}.recovering")
    draft.unlink(missing_ok=True)  # one fixed name: the next recorder removes what is left
    recover_file(path, draft)
    ring.mended_inode = draft.stat().st_ino
    draft.replace(path)


def _create_log(path: Path) -> BufferedRandom:
    try:
        return path.open("x+b")
    except FileExistsError:
        raise LogError(
            f"{path} exists, and a log is never overwritten; give --log another name"
        ) from None
    except OSError as error:
        raise LogError(
            f"cannot create the log {path}: {error.strerror}; give --log another place"
        ) from error


def _reserve_space(ring: Ring, file: BufferedRandom, path: Path, *, is_new: bool) -> Reserve:
    reserve = Reserve(file.fileno(), ring.rows * (ROW_BYTES + _MESSAGE_BYTES))
    try:
        reserve.extend(0, 0)
    except OSError as error:
        if is_new:
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


class _Recording:
    """Writes the log, chunk by chunk."""

    def __init__(self, ring: Ring, file: BufferedRandom, reserve: Reserve, rows: RowLogger) -> None:
        self._ring = ring
        self._file = file
        self._reserve = reserve
        self._rows, self._writer = rows, rows.writer
        self._file.flush()
        self._full = False
        # A slow disk may take seconds. Meanwhile the ring must be emptied and beats must go on.
        self._syncing = ThreadPoolExecutor(1)
        self._sync = self._syncing.submit(_sync_data, file.fileno())
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
            self._sync = self._syncing.submit(_sync_data, self._file.fileno())
            self._synced_at = now

    def finish(self) -> None:
        """Write the remaining rows, the index and the footer; return when they are on the disk."""
        while self._ring.pending:
            self._ring.recorder_beats += 1
            self._write_chunk()
        # A failed write-back is reported only once: here, or in the fsync below.
        self._await_disk(self._sync)
        self._writer.finish()
        self._file.flush()
        self._reserve.release(self._file.tell())
        self._await_disk(self._syncing.submit(os.fsync, self._file.fileno()))
        self._syncing.shutdown()
        self._ring.raise_flag(RecorderFlag.FINISHED)

    def _await_disk(self, sync: Future[None]) -> None:
        """Wait for the disk and beat meanwhile: a recorder without a sign of life is killed."""
        while not wait([sync], ROUND_S).done:
            self._ring.recorder_beats += 1
        sync.result()

    def _write_chunk(self) -> None:
        self._extend_reserve()
        batch = self._ring.drain(self._most)
        self._rows.write(batch)
        self._ring.commit(batch.end_row)

    def _extend_reserve(self) -> None:
        if self._full:
            return
        try:
            self._reserve.extend(self._file.tell(), self._writer.index.chunks)
        except OSError as error:
            if not is_full(error):
                raise
            # The loop stops on this flag; until then its rows go into the reserve.
            self._full = True
            self._ring.raise_flag(RecorderFlag.DISK_FULL)


STEP_BYTES = 4 << 20

# The summary has an index entry for each chunk, and everything else.
_SUMMARY_BYTES = 64 << 10
_SUMMARY_BYTES_PER_CHUNK = 256
_FALLOC_FL_KEEP_SIZE = 1
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_UNSUPPORTED = (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)


def is_full(error: OSError) -> bool:
    """Tell whether an error means that the disk, the quota or the file size limit is reached."""
    return error.errno in _FULL


class Reserve:
    """Reserved space after the end of one file."""

    def __init__(self, fd: int, backlog_bytes: int) -> None:
        """`backlog_bytes` is the most that may still have to be written at any time."""
        self._fd = fd
        self._backlog = backlog_bytes
        self._end = 0
        self.supported = True
        """Whether this file system can reserve space; if not, its free space is watched."""

    def extend(self, position: int, chunks: int) -> None:
        """Reserve space after `position`; raise OSError if the disk is full."""
        needed = position + self._backlog + _SUMMARY_BYTES + chunks * _SUMMARY_BYTES_PER_CHUNK
        if needed > self._end:
            self._allocate(self._end, needed + STEP_BYTES)

    def release(self, position: int) -> None:
        """Return the space after the end of the finished file."""
        os.ftruncate(self._fd, position)

    def _allocate(self, start: int, end: int) -> None:
        if sys.platform != "linux":  # nothing can be reserved there, and no valve depends on it
            return
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        if limit != resource.RLIM_INFINITY and end > limit:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        if self.supported:
            try:
                _fallocate(self._fd, start, end - start)
            except OSError as error:
                if error.errno not in _UNSUPPORTED:
                    raise
                self.supported = False
        if not self.supported:
            self._require_free(end - start)
        self._end = end

    def _require_free(self, size: int) -> None:
        disk = os.fstatvfs(self._fd)
        if disk.f_bavail * disk.f_frsize < size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _fallocate(fd: int, start: int, size: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    allocate = getattr(libc, "fallocate64", None) or libc.fallocate
    allocate.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)
    while allocate(fd, _FALLOC_FL_KEEP_SIZE, start, size) != 0:
        code = ctypes.get_errno()
        if code != errno.EINTR:
            raise OSError(code, os.strerror(code))


_TOPICS = {
    RowKind.EVENT: EVENT_TOPIC,
    RowKind.GAINS: GAINS_TOPIC,
    RowKind.KEYFRAME: KEYFRAME_TOPIC,
}


class RowLogger:
    """Writes batches of a run's rows into its log."""

    def __init__(self, writer: LogWriter, meta: RunMeta) -> None:
        """Begin the log, as far as it is not begun."""
        self.writer = writer
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
        self.writer.end_chunk()

    def _write_ticks(self, rows: NDArray[Any]) -> None:
        is_new = rows["tick"] > self.last_tick
        rows = rows if is_new.all() else rows[is_new]
        messages = make_message_records(
            self._layout.encode(rows["columns"]),
            np.maximum(rows["t_ns"] + self._wall_less_mono, 0),
            rows["tick"],
        )
        self.writer.add(self._channels[TICK_TOPIC], messages)
        self.written[TICK_TOPIC] += len(rows)

    def _write_entry(self, entry: Entry) -> None:
        if entry.row <= self.last_row:
            return
        value = self._decode_entry(entry)
        if value.get("event") in _METADATA_EVENTS:
            self.writer.metadata(value["event"], _values_to_text(value))
        where = {"tick": entry.tick, "t_ns": entry.t_ns, "row": entry.row}
        time = max(entry.t_ns + self._wall_less_mono, 0)
        topic = _TOPICS[entry.kind]
        message = make_message_record(to_json({**value, **where}), time, entry.tick)
        self.writer.add(self._channels[topic], message)
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
