"""Finish a dead recorder's log in a separate process.

`python -m pamctl.recording.finish_apart RING`

The calling process goes on watching a rig. The memory and processor time of this work end with
the separate process. Standard output is one JSON line.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from hal.child import child_command
from pamctl.recording.recorder import outlive_signals

_PATIENCE_S = 600.0
"""Time to copy the longest log."""


class FinishedLog(NamedTuple):
    """A finished log."""

    destination: str
    lossless: bool
    """Whether everything that was logged is in it."""


class FinishError(Exception):
    """The log cannot be finished now; the ring and the unfinished log stay."""


def finish_in_own_process(ring_path: str | Path) -> FinishedLog:
    """Finish the log of a dead recorder, and remove the ring; raise `FinishError`."""
    command = child_command("pamctl.recording.finish_apart", ring_path)
    # Ctrl-C reaches the terminal's process group; it must not end this process half-way.
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            process_group=0,
            timeout=_PATIENCE_S,
        )
    except subprocess.TimeoutExpired:
        raise FinishError(f"it was not finished within {_PATIENCE_S:g} s") from None
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise FinishError(said or f"the process that finishes it ended with {done.returncode}")
    return FinishedLog(**json.loads(done.stdout))


def main(arguments: list[str]) -> int:
    """Finish the log of the ring given as the only argument; return the exit code."""
    outlive_signals()
    from pamctl.recording.finish_from_ring import (
        finish_from_ring,  # slow imports: not in the calling process
    )

    (ring_path,) = arguments
    try:
        recovery = finish_from_ring(ring_path)
    # Every failure becomes one line for the user.
    except Exception as error:
        print(str(error) or type(error).__name__, file=sys.stderr)
        return 1
    print(json.dumps(FinishedLog(recovery.destination, recovery.lossless)._asdict()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
