"""The finisher: `python -m pamctl.processes.finisher_main RING`, for a run whose front is dead.

The front finishes the log of a dead recorder. If the front is dead too, guardian and loop each
start a finisher after the valve is safe. It is a process of its own, because the guardian would
kill a loop that takes long to leave. A finisher waits for a recorder that works, kills one that
is frozen, and leaves the rest to the code that finishes the logs of dead runs at every start.
Two finishers do no harm: the ring can be claimed by one only.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from hal.child import child_command
from pamctl.recording.recorder import RECORDER_PATIENCE_S, outlive_signals
from pamctl.recording.ring import Ring, RingError

_LOOK_EVERY_S = 0.1


def start_finisher(ring_path: Path) -> None:
    """Start a finisher that outlives this process."""
    subprocess.Popen(
        child_command("pamctl.processes.finisher_main", ring_path),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def main() -> int:
    """Finish the log of the ring that the first argument names."""
    outlive_signals()
    # The loop's CPU is not the only one that this work may use.
    with suppress(OSError):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    from pamctl.recording.orphans import finish_orphans

    path = Path(sys.argv[1])
    with suppress(RingError):  # it is gone: the log is finished
        with Ring.attach(path) as ring:
            _await_recorder_end(ring)
        finish_orphans(path.parent, quiet=True)
    return 0


def _await_recorder_end(ring: Ring) -> None:
    """Return when the recorder has ended; kill one that gives no sign of life."""
    from pamctl.recording.finish_from_ring import LOOP_DEAD_NS

    def is_claimed() -> bool:
        return time.monotonic_ns() - ring.loop_beat_ns > LOOP_DEAD_NS and ring.claim()

    beats, since_s = ring.recorder_beats, time.monotonic()
    while ring.path.exists() and not is_claimed():
        time.sleep(_LOOK_EVERY_S)
        if ring.recorder_beats != beats:
            beats, since_s = ring.recorder_beats, time.monotonic()
        elif time.monotonic() - since_s > RECORDER_PATIENCE_S:
            _kill_recorder(ring)


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


if __name__ == "__main__":
    sys.exit(main())
