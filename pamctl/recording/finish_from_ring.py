"""Finish the log of a dead recorder: from the unfinished file, and the rows left in the ring.

An unfinished log lacks its index and the chunk that was being written. The rows of that chunk
are still in the ring, unless the machine itself went down.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BufferedWriter
from itertools import count
from pathlib import Path
from time import monotonic_ns
from typing import NamedTuple

from pamctl.log.framing import LogError
from pamctl.log.recover import LogCopy, Recovery, sign_recovery
from pamctl.log.writer import LogWriter
from pamctl.recording.drain import RowLogger
from pamctl.recording.ring import RecorderFlag, Ring

LOOP_DEAD_NS = 2_000_000_000
"""A ring whose loop has been silent for this long may be finished."""


class Orphan(NamedTuple):
    """A ring that no process holds: its log was finished, or `problem` says why not."""

    ring: Path
    recovery: Recovery | None
    problem: str


def finish_from_ring(ring_path: str | Path) -> Recovery:
    """Finish the log of a dead recorder in its place, then remove the ring.

    The recorder must be dead, and the loop must have put its last row. Raise RingError if there is
    no such ring, LogError or OSError if the log cannot be written. Then the ring and the
    unfinished log stay.
    """
    with Ring.attach(ring_path) as ring:
        ring.hold()  # the next start must not take the ring for an orphan's
        recovery = _finish(ring)
        ring.unlink()
    return recovery


def recover_orphans(directory: str | Path = "/dev/shm") -> list[Orphan]:
    """Finish the logs of runs whose processes all died; remove their rings.

    A ring that cannot be handled raises nothing: its `Orphan` has the problem.
    """
    found: list[Orphan] = []
    for path in sorted(Path(directory).glob("pamctl-*.ring")):
        try:
            if not _is_my_file(path):
                continue
            with Ring.attach(path) as ring:
                if ring.claim() and monotonic_ns() - ring.loop_beat_ns > LOOP_DEAD_NS:
                    _require_home(ring)
                    found.append(Orphan(path, _finish(ring), ""))
                    ring.unlink()
        # One bad ring must not stop a rig from starting, or another log from being saved.
        except Exception as error:
            if path.exists():  # a run that ended meanwhile has removed its ring
                found.append(Orphan(path, None, str(error)))
    return found


def _is_my_file(path: Path) -> bool:
    """Tell whether this user owns the ring: it names the file to write.

    Nobody may tell another user, or root, which file to replace.
    """
    return not path.is_symlink() and path.stat().st_uid == os.geteuid()


def _require_home(ring: Ring) -> None:
    folder = Path(ring.meta.log_path).parent
    if not folder.is_dir():
        detail = f"{folder} is gone; create it again and the next start finishes the log there"
        raise LogError(f"{detail}, or remove the ring to give up the log: rm {ring.path}")


def _finish(ring: Ring) -> Recovery:
    target = Path(ring.meta.log_path)
    if ring.recorder_flags & RecorderFlag.FINISHED:
        return Recovery(str(target), str(target), {}, (), lossless=True, bytes_lost=0)
    has_part = _is_ours(target, ring)
    if has_part:
        # An earlier attempt to finish may have made this file. Record its inode before the draft
        # replaces the inode in the ring: until the draft is in place, this file is still ours.
        ring.log_inode = target.stat().st_ino
    else:
        target = _unused(target)
    with _replacing(target, ring) as stream:
        writer = LogWriter(stream)
        copy = LogCopy(target if has_part and target.stat().st_size else None)
        copy.write(writer)
        rows = RowLogger(writer, ring.meta)
        rows.last_tick, rows.last_row = copy.last_tick, copy.last_row
        rest = ring.drain(ring.rows)
        rows.write(rest)
        copy.saved += rows.written
        source = f"{target if has_part else 'no file'} and {ring.path}"
        # If the file was cut short, the ring holds the rest.
        recovery = replace(copy.describe(source, target), lossless=not copy.lost)
        sign_recovery(writer, recovery)
    ring.commit(rest.end_row)
    ring.raise_flag(RecorderFlag.FINISHED)
    return recovery


def _is_ours(path: Path, ring: Ring) -> bool:
    """Tell whether the ring's recorder created the file."""
    return path.exists() and path.stat().st_ino in (ring.log_inode, ring.mended_inode)


def _unused(path: Path) -> Path:
    names = (path.with_stem(f"{path.stem}{suffix}") for suffix in _suffixes())
    return next(name for name in names if not name.exists())


def _suffixes() -> Iterator[str]:
    yield ""
    yield "-recovered"
    yield from (f"-recovered-{number}" for number in count(2))


@contextmanager
def _replacing(target: Path, ring: Ring) -> Iterator[BufferedWriter]:
    """Open a draft beside the target; it replaces the target when the block ends well."""
    draft = target.with_name(f"{target.name}.recovering")
    draft.unlink(missing_ok=True)
    try:
        with draft.open("xb") as stream:  # one fixed name: the next finisher removes what is left
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            ring.mended_inode = os.fstat(stream.fileno()).st_ino
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    draft.replace(target)
    directory = os.open(target.parent, os.O_RDONLY)
    os.fsync(directory)
    os.close(directory)
