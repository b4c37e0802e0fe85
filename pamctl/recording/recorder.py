"""The recorder process: `python -m pamctl.recording.recorder RING`.

It ends when the loop is done, or when the loop is dead and the owner has closed standard input.
Signals do not end it: a terminal or a service manager sends them to every process of a run, and
the recorder must finish the log after the others have ended.

Exit codes: 0 the log is complete, 3 the disk was full and the log ends early, 1 failure.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

from hal.child import child_command
from pamctl.kept_memory import keep_freed_memory
from pamctl.recording.drain import is_full
from pamctl.recording.ring import RecorderFlag, Ring, RingError

RECORDER_PATIENCE_S = 5.0
"""A recorder without a heartbeat for this time, whose loop has ended, is killed."""
_POLL_S = 0.005


class RecorderError(Exception):
    """The recorder did not start; the message is the recorder's own."""


def spawn_recorder(ring_path: str | Path) -> subprocess.Popen[bytes]:
    """Start the recorder. It treats a closed `stdin` as the end of its owner."""
    return subprocess.Popen(
        child_command("pamctl.recording.recorder", ring_path),
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # Ctrl-C reaches the terminal's process group; it must not reach the starting recorder.
        process_group=0,
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


class _Pipe:
    """The owner, seen from the reading end of a pipe."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self.gone = False

    def wait(self, seconds: float) -> None:
        if self.gone:
            time.sleep(seconds)
        elif select.select([self._fd], [], [], seconds)[0]:
            self.gone = os.read(self._fd, 4096) == b""


def outlive_signals() -> None:
    """Ignore the signals that end the other processes of a run, whose work this one completes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


def main(arguments: list[str]) -> int:
    """Record the ring given as the only argument; return the exit code."""
    outlive_signals()
    keep_freed_memory()
    try:
        (ring_path,) = arguments
        with Ring.attach(ring_path) as ring:
            ring.hold()
            ring.recorder_pid = os.getpid()
            return _record(ring, _Pipe(sys.stdin.fileno()))
    except (ValueError, RingError) as error:
        print(f"recorder: {error}", file=sys.stderr)
        return 1


def _record(ring: Ring, owner: _Pipe) -> int:
    try:
        # Slow imports: only after the signals are ignored and the ring is held.
        from pamctl.recording.drain import record_run

        whole = record_run(ring, owner)
    # After any failure the loop must know, and the user gets one line.
    except Exception as error:
        full = isinstance(error, OSError) and is_full(error)
        ring.raise_flag(RecorderFlag.FAILED | (RecorderFlag.DISK_FULL if full else 0))
        kept = f"; {ring.pending} rows are kept in {ring.path}" if ring.pending else ""
        print(f"recorder: {_describe_error(error)}{kept}", file=sys.stderr)
        return 3 if ring.recorder_flags & RecorderFlag.DISK_FULL else 1
    if owner.gone:
        ring.unlink()
    if not whole:
        print(f"recorder: the disk is full: {ring.meta.log_path} ends early", file=sys.stderr)
    return 0 if whole else 3


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
