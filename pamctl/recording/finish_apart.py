"""Finish a dead recorder's log in a separate process.

`python -m pamctl.recording.finish_apart RING`

Whoever asks for it goes on watching over a rig: what a log's worth of work takes in memory, and
in the interpreter's time, ends with this process. Standard output is one JSON line.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple


class FinishedLog(NamedTuple):
    """A log that was finished."""

    destination: str
    lossless: bool
    """Whether all that was ever logged is in it."""


class FinishError(Exception):
    """The log cannot be finished now; the ring and what there is of the log stay."""


def finish_in_own_process(ring_path: str | Path) -> FinishedLog:
    """Finish the log of a recorder that is dead, and remove the ring; raise `FinishError`."""
    command = [sys.executable, "-m", "pamctl.recording.finish_apart", str(ring_path)]
    # Ctrl-C goes to the terminal's process group, and must not end this half-way.
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, process_group=0)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise FinishError(said or f"the process that does it ended with {done.returncode}")
    return FinishedLog(**json.loads(done.stdout))


def main(arguments: list[str]) -> int:
    """Finish the log of the ring that the only argument names; return the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    from pamctl.recording.finish_from_ring import (
        finish_from_ring,  # not in the process that asks for it
    )

    (ring_path,) = arguments
    try:
        recovery = finish_from_ring(ring_path)
    # Whatever went wrong, it is one line for the user.
    except Exception as error:
        print(str(error) or type(error).__name__, file=sys.stderr)
        return 1
    print(json.dumps(FinishedLog(recovery.destination, recovery.lossless)._asdict()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
