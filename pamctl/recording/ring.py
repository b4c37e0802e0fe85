"""The ring between loop and recorder: a file in shared memory.

    header, 4 KiB | run meta, JSON | slot for orders | cargo | rows of 512 bytes

One process puts rows, another takes them; neither waits for the other. The head moves after a
row is complete, the tail after it is in the log. Rows between the two survive the death of either
process, or of both. Payloads longer than a row continue in the following rows, and become visible
with a single move of the head.

Memory order: the loop stores the row and then the head; the recorder reads the head and then the
row, and copies the row before it stores the tail. x86 keeps these orders. Other processors may
reorder stores and reads: there the side that reads asks the kernel for a full barrier on every CPU
on which a process with a ring runs (`membarrier`), so that the loop pays nothing, or the ring is
refused. Header words are eight aligned bytes: no processor of 64 bits tears them.

A ring without a file is for two threads of one process.

Rows and header are little-endian; times are nanoseconds of the monotonic clock.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import platform
import struct
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import monotonic_ns

from hal.reservation import open_regular
from pamctl.base.errors import ExitCode
from pamctl.base.texts import to_json
from pamctl.log.run_meta import RunMeta
from pamctl.recording.rows import (
    PAYLOAD_BYTES,
    ROW_BYTES,
    ROW_HEADER,
    RowBatch,
    RowKind,
    count_rows,
    tick_struct,
)

HEADER_BYTES = 4096

_MAGIC = b"PAMRING\n"
_VERSION = 2
_HEAD = 8
_CACHE_LINE = 64
_MADV_POPULATE_WRITE, _MADV_DONTNEED_LOCKED = 23, 24
_POPULATE_BYTES = 64 * mmap.PAGESIZE
"""Touched at once: some tens of microseconds."""


class RecorderFlag:
    """Bits of `Ring.recorder_flags`. The loop must stop on `DISK_FULL` and on `FAILED`."""

    READY = 1
    DISK_FULL = 2
    FAILED = 4
    FINISHED = 8
    GAPS = 16
    """Parts of the log were damaged, or its first part is in another file."""


LOOP_DEAD_NS = 2_000_000_000
"""A loop that has been silent for this long, and whose ring nobody holds, is dead."""


class LoopStage:
    """How long the loop may be silent depends on `Ring.loop_stage`; stages in order."""

    SETTING_UP = 0
    TICKING = 1
    LEAVING = 2
    """The rig is safe, no tick follows."""


class RingError(Exception):
    """The ring cannot be created, or the file is not a ring of this version."""

    exit_code = ExitCode.UNAVAILABLE


class RingFull(RingError):
    """No room for the row: the recorder is behind, or gone."""


@contextlib.contextmanager
def _explain_errors(what: str) -> Iterator[None]:
    try:
        yield
    except FileExistsError as error:
        raise RingError(f"{what}: it exists; a run is using it, or died") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RingError(f"{what}: {error}") from error


@contextlib.contextmanager
def _close_on_error(fd: int) -> Iterator[None]:
    try:
        yield
    except BaseException:
        os.close(fd)
        raise


def _give_name(fd: int, path: Path) -> None:
    """Make an unnamed file appear at `path`, if nothing is there."""
    directory = os.open(path.parent, os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        # Python follows the link only if it gets a directory.
        os.link(f"/proc/self/fd/{fd}", path.name, dst_dir_fd=directory, follow_symlinks=True)
    finally:
        os.close(directory)


def _lay_out(
    meta: RunMeta, rows: int, cargo: bytes = b"", slot_bytes: int = 0
) -> tuple[bytes, int]:
    """Return what stands before the rows of a new ring, and the bytes of the whole ring."""
    text = replace(meta, log_path=os.path.abspath(meta.log_path)).to_text()
    text += b" " * (-len(text) % _CACHE_LINE)  # the slot's words must not be torn
    before_rows = len(text) + slot_bytes + len(cargo)
    rows_at = HEADER_BYTES + -(-before_rows // mmap.PAGESIZE) * mmap.PAGESIZE
    words = (_VERSION, ROW_BYTES, rows, len(text), rows_at, len(cargo), slot_bytes)
    header = struct.pack("<8s7Q", _MAGIC, *words).ljust(HEADER_BYTES, b"\0")
    return header + text + bytes(slot_bytes) + cargo, rows_at + rows * ROW_BYTES


def _map_file(fd: int, *, populate: bool) -> mmap.mmap:
    mapped = mmap.mmap(fd, 0, flags=mmap.MAP_SHARED | (mmap.MAP_POPULATE if populate else 0))
    if populate:
        for _ in _populate(mapped, len(mapped)):
            pass
    return mapped


def _populate(mapped: mmap.mmap, step_bytes: int) -> Iterator[None]:
    for start in range(0, len(mapped), step_bytes):
        with contextlib.suppress(OSError):
            length = min(step_bytes, len(mapped) - start)
            mapped.madvise(_MADV_POPULATE_WRITE, start, length)
        yield


class _Word:
    """A 64-bit word of the header, at `index`. Only one process writes each word."""

    def __init__(self, index: int) -> None:
        self._index = index

    def __get__(self, ring: Ring, owner: type | None = None) -> int:
        return ring._words[self._index]

    def __set__(self, ring: Ring, value: int) -> None:
        ring._words[self._index] = value


class Ring:
    """A ring attached to this process. One process puts rows, one process commits them."""

    # Words that different processes write are on different cache lines (8 words each).
    # The magic is word 0.
    _version, _row_bytes, _row_count = _Word(1), _Word(2), _Word(3)
    _meta_bytes, _rows_start, cargo_bytes = _Word(4), _Word(5), _Word(6)
    """The cargo is what the maker of the ring hands to the loop; nobody else reads it."""
    slot_bytes = _Word(7)
    """Size of the slot for orders to the loop; zero for none."""
    head = _Word(_HEAD)
    """Number of rows put. Written by the loop."""
    tail = _Word(16)
    """Number of rows that are in the log. Written by the recorder."""
    recorder_beats = _Word(24)
    """Increased in every round of the recorder."""
    recorder_flags = _Word(25)
    """Bits of `RecorderFlag`. Written by the recorder."""
    log_inode = _Word(26)
    """Inode of the recorder's log file; zero before it exists."""
    mended_inode = _Word(27)
    """Inode of the draft that replaces the log when another process finishes it; else zero."""
    recorder_pid = _Word(28)
    """Process id of the recorder; zero before it starts. Written by the recorder."""
    loop_beat_ns = _Word(32)
    """Monotonic time of the loop's last sign of life."""
    loop_done = _Word(33)
    """Not zero after the last row."""
    worst_late_ns = _Word(34)
    """The loop's worst wake-up so far."""
    loop_stage = _Word(36)
    """One of `LoopStage`. Written by the loop."""
    missed_ticks = _Word(37)
    """Grid points skipped so far. Written by the loop of a session."""
    guardian_ready = _Word(40)
    """Not zero once the guardian watches the loop. Written by the guardian."""
    guardian_beats = _Word(41)
    """Increased whenever the guardian has checked the loop."""
    loop_pid = _Word(48)
    """Process id of the loop; zero before it starts. Written by the front."""
    guardian_lost = _Word(49)
    """Not zero once the guardian is dead or frozen. Written by the front."""

    def __init__(self, path: Path, fd: int, mapped: mmap.mmap, *, meta: str | None = None) -> None:
        """Use the ring in `mapped`, whose file `fd` this object owns from now on; -1 for none.

        With `meta` that of the ring, which may be long, is not read.
        """
        self.path = path
        self._fd = fd
        self._barrier = barrier_of_this_machine() if fd >= 0 else _do_nothing
        self._map = mapped
        self._buffer = memoryview(self._map)
        if len(self._buffer) < HEADER_BYTES or self._buffer[: len(_MAGIC)] != _MAGIC:
            raise RingError(f"{self.path} is not a ring of pamctl")
        self._words = self._buffer[:HEADER_BYTES].cast("Q")
        self._check_layout()
        text = meta or self._buffer[HEADER_BYTES:][: self._meta_bytes].tobytes()
        self.meta = RunMeta.from_text(text)
        self.rows = self._row_count
        self._rows_at = self._rows_start
        self._head = self.head
        self._full_at = self.tail + self.rows
        self.await_room: Callable[[Callable[[], bool]], None] | None = None
        """Called in a full ring with the test for room; it returns when there is room, or none to
        be expected. None: nobody waits, as a clock goes on meanwhile."""
        self._prepare_packing()

    @classmethod
    def create(
        cls,
        path: str | Path,
        meta: RunMeta,
        rows: int = 16384,
        cargo: bytes = b"",
        *,
        slot_bytes: int = 0,
    ) -> Ring:
        """Create a ring, hold it, and return it; raise RingError if it exists.

        It appears complete or not at all, and only this user can read it. All its memory is
        allocated now, not later when shared memory may be full.
        """
        path = Path(path)
        front, size = _lay_out(meta, rows, cargo, slot_bytes)
        with _explain_errors(f"cannot make the ring {path}"):
            fd = os.open(path.parent, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
            with _close_on_error(fd):
                os.posix_fallocate(fd, 0, size)
                os.pwrite(fd, front, 0)
                ring = cls(path, fd, _map_file(fd, populate=True))
                ring.loop_beat_ns = monotonic_ns()
                ring.hold()
                _give_name(fd, path)
        return ring

    @classmethod
    def in_memory(cls, meta: RunMeta, rows: int = 16384) -> Ring:
        """Make a ring for two threads of this process, on any system; it is gone with the process.

        The interpreter's lock keeps their accesses in order, so it needs no barrier.
        """
        front, size = _lay_out(meta, rows)
        mapped = mmap.mmap(-1, size)
        mapped[: len(front)] = front
        return cls(Path(), -1, mapped)

    @classmethod
    def attach(cls, path: str | Path, *, populate: bool = True, meta: str | None = None) -> Ring:
        """Map an existing ring; raise RingError if it is not a ring of this version.

        Without `populate` the caller goes through `populate_in_steps` before it puts rows. With
        `meta` that of the ring, which may be long, is not read.
        """
        with _explain_errors(f"cannot attach to the ring {path}"):
            fd = open_regular(Path(path), os.O_RDWR, "me")
            with _close_on_error(fd):
                return cls(Path(path), fd, _map_file(fd, populate=populate), meta=meta)

    @classmethod
    def watch(cls, path: str | Path) -> Ring:
        """Map an existing ring for reading only; raise RingError as `attach` does."""
        with _explain_errors(f"cannot look into the ring {path}"):
            fd = open_regular(Path(path), os.O_RDONLY, "any")
            with _close_on_error(fd):
                return cls(Path(path), fd, mmap.mmap(fd, 0, prot=mmap.PROT_READ))

    def read_cargo(self, start: int, size: int) -> bytes:
        """Return so many bytes of the cargo from a place on."""
        at = HEADER_BYTES + self._meta_bytes + self.slot_bytes + start
        return self._buffer[at : at + size].tobytes()

    @property
    def slot(self) -> memoryview:
        """The memory for orders; whoever takes it lets it go before the ring is closed."""
        at = HEADER_BYTES + self._meta_bytes
        return self._buffer[at : at + self.slot_bytes]

    def admit_readers(self, group: int) -> None:
        """Let the members of a group, by its number, read this ring; nobody else may write."""
        os.fchown(self._fd, -1, group)
        os.fchmod(self._fd, 0o640)

    def populate_in_steps(self) -> Iterator[None]:
        """Touch every page: the first write to a mapped page would fault within a tick."""
        return _populate(self._map, _POPULATE_BYTES)

    def _check_layout(self) -> None:
        if (self._version, self._row_bytes) != (_VERSION, ROW_BYTES):
            raise RingError(
                f"{self.path} is a ring of layout {self._version}, this pamctl knows {_VERSION}; "
                "recover it with the version that made it"
            )
        if self._rows_start + self._row_count * ROW_BYTES != len(self._buffer):
            raise RingError(f"{self.path} is not whole")

    def _prepare_packing(self) -> None:
        columns = tick_struct(self.meta.tick_fields)
        if columns.size > PAYLOAD_BYTES:
            raise RingError(f"a tick of {columns.size} bytes exceeds a row's {PAYLOAD_BYTES}")
        self._tick = columns
        self._keyframe = struct.Struct(f"<{len(self.meta.keyframe_fields)}d")

    # The loop's side.

    def put_row(self, row: bytearray) -> None:
        """Put one tick, packed as `make_rows` has it. Raise RingFull if there is no room."""
        head = self._head
        if head >= self._full_at:
            self._make_room(1)
        at = self._rows_at + head % self.rows * ROW_BYTES
        self._buffer[at : at + ROW_BYTES] = row
        self._head = self._words[_HEAD] = head + 1

    def put_rows(self, rows: memoryview) -> None:
        """Put many packed ticks, as there is room for them."""
        while rows:
            head = self._head
            if head >= self._full_at:
                self._make_room(1)
            start = head % self.rows
            count = min(len(rows) // ROW_BYTES, self._full_at - head, self.rows - start)
            at, size = self._rows_at + start * ROW_BYTES, count * ROW_BYTES
            self._buffer[at : at + size] = rows[:size]
            self._head = self._words[_HEAD] = head + count
            rows = rows[size:]

    def rehearse_row(self, row: bytearray) -> None:
        """Copy a packed tick into the next row and do not move the head."""
        if self._head < self._full_at:
            at = self._rows_at + self._head % self.rows * ROW_BYTES
            self._buffer[at : at + ROW_BYTES] = row

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Put an event: a JSON object whose key `event` names it.

        The log adds the keys `tick`, `t_ns` and `row`. Raise RingFull if there is no room.
        """
        self.put_event_text(tick, t_ns, to_json(event))

    def put_event_text(self, tick: int, t_ns: int, text: bytes) -> None:
        """Put an event that is JSON already; as `put_event`."""
        self._put(RowKind.EVENT, tick, t_ns, text)

    def put_gains(self, tick: int, t_ns: int, gains: Mapping[str, object]) -> None:
        """Put the gains that hold from this tick on; as `put_event`."""
        self._put(RowKind.GAINS, tick, t_ns, to_json(gains))

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Put the frozen state: one double for each of the meta's `keyframe_fields`."""
        self._put(RowKind.KEYFRAME, tick, t_ns, self._keyframe.pack(*state))

    def _put(self, kind: int, tick: int, t_ns: int, payload: bytes) -> None:
        span = count_rows(len(payload))
        if span > self.rows // 2:
            raise RingError(f"{len(payload)} bytes of JSON exceed half the ring")
        if self._head + span > self._full_at:
            self._make_room(span)
        for index in range(span):
            at = self._rows_at + (self._head + index) % self.rows * ROW_BYTES
            piece = payload[index * PAYLOAD_BYTES : (index + 1) * PAYLOAD_BYTES]
            ROW_HEADER.pack_into(self._buffer, at, kind, len(payload), tick, t_ns)
            self._buffer[at + ROW_HEADER.size :][: len(piece)] = piece
            kind = RowKind.CONTINUATION
        self._head = self.head = self._head + span

    def take_over(self) -> None:
        """Continue here for a producer that is dead."""
        self._head = self.head
        self._full_at = self.tail + self.rows

    def _make_room(self, rows: int) -> None:
        self._full_at = self.tail + self.rows
        needed = self._head + rows
        if needed > self._full_at and self.await_room is not None:
            self.await_room(lambda: self.tail + self.rows >= needed)
            self._full_at = self.tail + self.rows
        if needed > self._full_at:
            raise RingFull(f"the ring's {self.rows} rows are full: the recorder is behind or gone")

    # The recorder's side.

    @property
    def pending(self) -> int:
        """Number of rows put and not yet committed."""
        return self.head - self.tail

    def drain(self, max_rows: int) -> RowBatch:
        """Copy the oldest rows, at most about `max_rows`; they stay in the ring."""
        self._barrier()  # after whatever the caller has read, such as `loop_done`
        first, head = self.tail, self.head
        self._barrier()
        end = min(first + max_rows, head)
        while end < head and self._kind(end) == RowKind.CONTINUATION:
            end += 1
        return RowBatch(first, self._copy(first, end))

    def commit(self, end_row: int) -> None:
        """Return the rows before `end_row` to the loop."""
        self._barrier()
        self.tail = end_row

    def raise_flag(self, flag: int) -> None:
        """Set a bit of `RecorderFlag`."""
        self.recorder_flags |= flag

    def _kind(self, row: int) -> int:
        at = self._rows_at + row % self.rows * ROW_BYTES
        return int.from_bytes(self._buffer[at : at + 4], "little")

    def _copy(self, first: int, end: int) -> bytes:
        rows = self._buffer[self._rows_at :]
        start, count = first % self.rows, end - first
        until_wrap = min(count, self.rows - start)
        ahead = rows[start * ROW_BYTES : (start + until_wrap) * ROW_BYTES]
        behind = rows[: (count - until_wrap) * ROW_BYTES]
        return b"".join((ahead, behind))

    # The front's side.

    def latest_tick(self) -> dict[str, float] | None:
        """Return the newest tick's columns by name, committed or not; None if there is none."""
        newest = self.recent_ticks(-1 << 62, 1, 1)
        return newest[0] if newest else None

    def recent_ticks(self, after: int, every: int, most: int) -> list[dict[str, float]]:
        """Return the ticks after tick `after` whose number is a multiple of `every`, oldest first.

        At most the newest `most` of them, from the newest quarter of the ring: older rows may be
        overwritten during the copy.
        """
        while True:
            head = self.head
            self._barrier()
            payloads: list[bytes] = []
            for row in range(head - 1, max(-1, head - 1 - self.rows // 4), -1):
                at = self._rows_at + row % self.rows * ROW_BYTES
                kind, _, tick, _ = ROW_HEADER.unpack_from(self._buffer, at)
                if kind == RowKind.TICK:
                    if tick <= after or len(payloads) == most:
                        break
                    if not tick % every:
                        payloads.append(self._copy(row, row + 1)[ROW_HEADER.size :])
            self._barrier()
            if self.head - head <= self.rows // 4:
                return [self._tick_columns(payload) for payload in reversed(payloads)]

    def copy_recent(self, first_row: int) -> RowBatch:
        """Copy the rows from `first_row` on, committed or not; it takes nothing from the recorder.

        At most the newest half of the ring: older rows may be overwritten during the copy. A batch
        may begin within an entry, or after `first_row`: then rows were lost.
        """
        while True:
            head = self.head
            self._barrier()
            first = min(max(first_row, head - self.rows // 2, 0), head)
            data = self._copy(first, head)
            self._barrier()
            if self.head - head <= self.rows // 4:
                return RowBatch(first, data)

    def read_tick(self, row: bytes) -> dict[str, float]:
        """Return the columns of a row with a tick by name."""
        return self._tick_columns(row[ROW_HEADER.size :][: self._tick.size])

    def _tick_columns(self, payload: bytes) -> dict[str, float]:
        names = (field.name for field in self.meta.tick_fields)
        return dict(zip(names, self._tick.unpack_from(payload), strict=True))

    # Life and death.

    def hold(self) -> None:
        """Mark the ring as used by this process, until it closes the ring or dies."""
        import fcntl  # a log is made from rows on other systems too

        fcntl.flock(self._fd, fcntl.LOCK_SH)

    def claim(self) -> bool:
        """Take the ring for this process alone; return False if another process holds it."""
        import fcntl

        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def claim_log(self) -> bool:
        """Take the log for this process alone; return False if another recorder has it.

        The kernel takes it back when the process dies.
        """
        return self._claim_byte(0)

    def claim_slot(self) -> bool:
        """Take the slot for this process alone; as `claim_log`."""
        return self._claim_byte(1)

    def _claim_byte(self, byte: int) -> bool:
        import fcntl

        try:
            fcntl.lockf(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
        except OSError:
            return False
        return True

    @property
    def is_file(self) -> bool:
        """Other processes can attach to it."""
        return self._fd >= 0

    def unlink(self) -> None:
        """Remove the file if it exists; processes that mapped it keep their memory."""
        if self.is_file:
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Unmap, and release the lock."""
        self._words.release()
        self._buffer.release()
        self._map.close()
        if self._fd >= 0:
            os.close(self._fd)

    def close_in_steps(self) -> Iterator[None]:
        """Give back some pages in each step, and close in the last; the ring keeps its content.

        All pages at once would take longer than a tick may.
        """
        for start in range(0, len(self._map), _POPULATE_BYTES):
            with contextlib.suppress(OSError):  # before Linux 5.18
                length = min(_POPULATE_BYTES, len(self._map) - start)
                self._map.madvise(_MADV_DONTNEED_LOCKED, start, length)
            yield
        self.close()

    def __enter__(self) -> Ring:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


_IN_ORDER = frozenset({"x86_64", "amd64", "i686", "i386"})
_MEMBARRIER = {"aarch64": 283, "riscv64": 283, "loongarch64": 283, "x86_64": 324, "ppc64le": 365}
"""Number of the system call."""
_GLOBAL_EXPEDITED, _REGISTER_GLOBAL_EXPEDITED = 2, 4


class MemoryOrderError(OSError):
    """No order can be promised of what another process sees of a ring."""


def choose_barrier(machine: str, byte_order: str = sys.byteorder) -> Callable[[], None]:
    """Return what a reader calls between two accesses that must stay in their order.

    On a machine that needs barriers this process takes part in them from now on. Raises
    `MemoryOrderError` where the machine is big-endian, or the kernel offers no barrier.
    """
    if byte_order != "little":
        raise MemoryOrderError(f"rings are little-endian, {machine} is not")
    if machine.lower() in _IN_ORDER:
        return _do_nothing
    return _make_kernel_barrier(machine)


def _do_nothing() -> None:
    """The processor keeps the order."""


def _make_kernel_barrier(machine: str) -> Callable[[], None]:
    number = _MEMBARRIER.get(machine)
    if number is None:
        raise MemoryOrderError(f"no barrier between processes is known for {machine}")
    call = ctypes.CDLL(None, use_errno=True).syscall

    def membarrier(command: int) -> None:
        arguments = (number, command, 0, 0)
        if call(*map(ctypes.c_long, arguments)):
            error = os.strerror(ctypes.get_errno())
            raise MemoryOrderError(f"{machine} reorders stores, and membarrier failed: {error}")

    membarrier(_REGISTER_GLOBAL_EXPEDITED)
    return lambda: membarrier(_GLOBAL_EXPEDITED)


def barrier_of_this_machine() -> Callable[[], None]:
    """Return the barrier of the machine that this process runs on."""
    return choose_barrier(platform.machine())
