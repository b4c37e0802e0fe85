"""The recorder process: `python -m pamctl.recording.recorder RING [alone]`.

It is crash-only: whoever finds a ring whose log is not finished starts a recorder on it, which
waits its turn, goes on behind the last whole chunk of the file, drains the ring from its tail, and
finishes the log. The front does so when a recorder has died; guardian and loop when the front has;
the next start for each ring that nobody holds. These last three are `alone`: they have no owner.

It ends when the loop is done, or when the loop is dead and the owner has closed standard input.
Signals do not end it: a terminal or a service manager sends them to every process of a run, and
the recorder must finish the log after the others have ended.

Exit codes: 0 the log is complete, 3 the disk was full and the log ends early, 1 failure.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hal.child import ParentPipe, child_command
from pamctl.base.errors import LOG_DISK_FULL, ExitCode
from pamctl.base.texts import count_of
from pamctl.recording.journal import StandStill
from pamctl.recording.ring import LOOP_DEAD_NS, RecorderFlag, Ring, RingError

if TYPE_CHECKING:
    from pamctl.recording.drain import Owner

RECORDER_PATIENCE_S = 5.0
"""A recorder without a heartbeat for this time, whose loop has ended, is killed."""
_POLL_S = 0.005
_LOOK_EVERY_S = 0.1
_ALONE_PATIENCE_S = 600.0
"""Time to read the longest log, and to write what a ring holds."""


class RecorderError(Exception):
    """The log cannot be written; the message is the recorder's own."""

    exit_code = ExitCode.UNEXPECTED


class Orphan(NamedTuple):
    """A ring that no process holds: its log was finished, or `problem` says why not."""

    ring: Path
    log: Path
    problem: str


# --- for others -----------------------------------------------------------------------------------


def spawn_recorder(ring_path: str | Path) -> subprocess.Popen[bytes]:
    """Start the recorder. It treats a closed `stdin` as the end of its owner."""
    return subprocess.Popen(
        child_command("pamctl.recording.recorder", ring_path),
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # Ctrl-C reaches the terminal's process group; it must not reach the starting recorder.
        process_group=0,
    )


def leave_recorder(ring_path: Path) -> None:
    """Start a recorder that outlives this process, for a run whose front is dead.

    Two of them do no harm: they take their turn, and the second finds nothing to do.
    """
    subprocess.Popen(
        child_command("pamctl.recording.recorder", ring_path, "alone"),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def await_recorder(ring: Ring, process: subprocess.Popen[bytes], timeout_s: float = 10.0) -> None:
    """Return when the log is open; raise RecorderError if that takes longer than `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while not ring.recorder_flags & RecorderFlag.READY:
        if process.poll() is not None:
            said = process.stderr.read().decode().strip() if process.stderr else ""
            raise RecorderError(said or f"the recorder ended with code {process.returncode}")
        if time.monotonic() > deadline:
            raise RecorderError(f"the recorder is not ready after {timeout_s:g} s")
        time.sleep(_POLL_S)


def finish_orphans(directory: Path, *, quiet: bool) -> list[Orphan]:
    """Finish the logs of runs whose processes all died; say so on standard error.

    A ring that cannot be handled raises nothing: its `Orphan` has the problem.
    """
    found = []
    for path in sorted(directory.glob("pamctl-*.ring")):
        log = Path()
        try:
            # It names the file to write: nobody may tell another user, or root, which one.
            if path.is_symlink() or path.stat().st_uid != os.geteuid():
                continue
            with Ring.attach(path, populate=False) as ring:
                log = Path(ring.meta.log_path)
                if not ring.claim() or time.monotonic_ns() - ring.loop_beat_ns <= LOOP_DEAD_NS:
                    continue
            problem = _explain_no_folder(log, path) or _record_alone(path)
        # One bad ring must not stop a rig from starting, or another log from being saved.
        except Exception as error:
            problem = str(error)
            if not path.exists():  # a run that ended meanwhile has removed its ring
                continue
        found.append(Orphan(path, log, problem))
        if not quiet:
            what = f"cannot finish its log: {problem}" if problem else f"finished {log}"
            print(f"an earlier run died ({path}): {what}", file=sys.stderr)
    return found


def _explain_no_folder(log: Path, ring: Path) -> str:
    if log.parent.is_dir():
        return ""
    detail = f"{log.parent} is gone; create it again and the next start finishes the log there"
    return f"{detail}, or remove the ring to give up the log: rm {ring}"


def _record_alone(ring_path: Path) -> str:
    """Finish a log; return why it could not be finished."""
    # Ctrl-C reaches the terminal's process group; it must not end the recorder half-way.
    done = subprocess.run(
        child_command("pamctl.recording.recorder", ring_path, "alone"),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        process_group=0,
        timeout=_ALONE_PATIENCE_S,
    )
    said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    if not ring_path.exists():
        return ""
    return said.removeprefix("recorder: ") or f"the recorder ended with {done.returncode}"


# --- the process ----------------------------------------------------------------------------------


def ignore_signals() -> None:
    """Ignore the signals that end a run: this process completes what the others leave."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


def main(arguments: list[str]) -> int:
    """Record the ring given as the first argument; return the exit code."""
    ignore_signals()
    try:
        ring_path, *alone = arguments
        owner = ParentPipe(sys.stdin.fileno())
        if alone:
            owner.gone = True
            # The CPU of the loop that started it is not the only one that it may use.
            with suppress(OSError):
                os.sched_setaffinity(0, range(os.cpu_count() or 1))
        with Ring.attach(ring_path) as ring:
            if not _await_turn(ring):
                return 0
            ring.hold()
            complaint = record(ring, owner)
            if owner.gone and ring.recorder_flags & RecorderFlag.FINISHED:
                ring.unlink()
            if not complaint:
                return 0
            print(f"recorder: {complaint}", file=sys.stderr)
            return 3 if ring.recorder_flags & RecorderFlag.DISK_FULL else 1
    except (ValueError, RingError) as error:
        print(f"recorder: {error}", file=sys.stderr)
        return 1


def _await_turn(ring: Ring) -> bool:
    """Return when this process alone has the log; False if another recorder has finished it.

    One that gives no sign of life is killed.
    """
    silence = StandStill(lambda: ring.recorder_beats)
    while not ring.claim_log():
        if not ring.path.exists():
            return False
        time.sleep(_LOOK_EVERY_S)
        if silence.lasts_s() > RECORDER_PATIENCE_S:
            _kill_recorder(ring)
    return ring.path.exists()


def _kill_recorder(ring: Ring) -> None:
    """Kill the recorder of this ring, but no other process that has got its id meanwhile."""
    with suppress(OSError):
        process = os.pidfd_open(ring.recorder_pid)
        try:
            command = Path(f"/proc/{ring.recorder_pid}/cmdline").read_bytes().split(b"\0")
            if os.fsencode(ring.path) in command:
                signal.pidfd_send_signal(process, signal.SIGKILL)
        finally:
            os.close(process)


def record(ring: Ring, owner: Owner) -> str:
    """Write the log of a ring to its end; return why it is not whole, nothing where it is.

    After a failure the loop knows it by the ring's flags, and the ring keeps what is not written.
    """
    ring.recorder_pid = os.getpid()
    try:
        # Slow imports: only after the signals are ignored and the ring is held.
        from pamctl.log.writer import keep_freed_memory
        from pamctl.recording.drain import is_full, record_run

        keep_freed_memory()

        if ring.recorder_flags & RecorderFlag.FINISHED or record_run(ring, owner):
            return ""
    except Exception as error:
        full = isinstance(error, OSError) and is_full(error)
        ring.raise_flag(RecorderFlag.FAILED | (RecorderFlag.DISK_FULL if full else 0))
        why = f"{LOG_DISK_FULL}: {_describe_error(error)}" if full else _describe_error(error)
        is_kept = ring.pending and ring.is_file
        return f"{why}; {count_of(ring.pending, 'row')} kept in {ring.path}" if is_kept else why
    return f"{LOG_DISK_FULL}: {ring.meta.log_path} ends early"


def _describe_error(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"writing the log failed: {error.strerror or error}"
    return str(error) or type(error).__name__


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stderr.flush()
    # The log is complete. An interpreter that takes itself apart could still be frozen, and nobody
    # would look for it.
    os._exit(code)
