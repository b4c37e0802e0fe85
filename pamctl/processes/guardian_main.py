"""The guardian process: `python -m pamctl.processes.guardian_main RING`, started by the front.

All it needs is in the ring's meta. The end of its standard input is the front's death. Its
standard output is one JSON line: what it had to do. Signals do not end it: it stays as long as
the loop does, and then until the front has finished the log.

Without a ring it is the watchman of `doctor` and `calibrate`. They drive the valve from the process
that talks to a person. The watchman waits for the death of that process, which the end of a pipe
reports at once, and then drives the safe voltage. A line on the pipe says that the work ended well.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from hal.child import ParentPipe, child_command
from hal.rig import Rig, RigError
from pamctl.base.errors import Ending, ExitCode
from pamctl.processes.backends import build_safe_rig, require_backend
from pamctl.processes.guardian import LoopProcess, Takeover, drive_safe, guard
from pamctl.processes.loop_supervisor import STARTS_WITHIN_S
from pamctl.realtime.scheduling import keep_single_threaded, prepare_guardian
from pamctl.recording.journal import end_for_dead_loop, put_event_for_dead_loop
from pamctl.recording.recorder import ignore_signals, leave_recorder
from pamctl.recording.ring import Ring, RingError
from pamctl.settings.rig_file import RigFile, read_resolved_rig

_ALL_WELL = b"all is well\n"
_END_PATIENCE_S = 20.0
"""Longer than the patience with a driver that drives the safe voltage."""


def main() -> int:
    """Guard the loop of the ring that the first argument names, or else a person's work."""
    ignore_signals()
    if len(sys.argv) < 2:
        return _watch_person()
    keep_single_threaded()
    front = ParentPipe(sys.stdin.fileno())
    with Ring.attach(sys.argv[1]) as ring:
        try:
            takeover = _guard(ring, front)
        except RigError as error:
            print(f"guardian: {error}", file=sys.stderr)
            return int(ExitCode.UNAVAILABLE)
        if takeover is not None:
            put_event_for_dead_loop(ring, takeover.event())
        with suppress(BrokenPipeError):  # the front may be dead
            print(json.dumps(takeover and takeover._asdict()), flush=True)
        while not front.wait(1.0):
            pass
        _end_log(ring, takeover)
    return int(ExitCode.OK)


def _guard(ring: Ring, front: ParentPipe) -> Takeover | None:
    file = read_resolved_rig(ring.meta.config)
    rig = build_safe_rig(file)
    # A rehearsal before the loop opens the rig: a guardian that cannot make it safe now cannot do
    # so later. It also loads the driver, which would cost a fraction of a second later.
    failure = drive_safe(rig, patience_s=1.0)
    if failure is not None:
        raise failure
    loop = LoopProcess(_await_loop_pid(ring, front))
    pace = file.loop
    prepare_guardian(ring.meta.config["rt"], pace.cpu)
    ring.guardian_ready = 1
    return guard(ring, loop, rig, round(pace.heartbeat_ms * 1e6), round(pace.starved_ms * 1e6))


def _await_loop_pid(ring: Ring, front: ParentPipe) -> int:
    """Wait for the front to start the loop."""
    deadline_s = time.monotonic() + STARTS_WITHIN_S
    while not ring.loop_pid:
        # A loop without a guardian that is ready never opens the rig: leaving is safe.
        if front.wait() or time.monotonic() > deadline_s:
            raise RigError("there is no loop to guard")
        time.sleep(1e-3)
    return ring.loop_pid


def _end_log(ring: Ring, takeover: Takeover | None) -> None:
    """Do what a front does that has died before it has finished the log and removed the ring.

    A daemon's guardian holds the ring of the session. The runs' own rings have names that begin
    with the same process id.
    """
    reason = (takeover and takeover.reason) or "the loop process died"
    for path in ring.path.parent.glob(f"{ring.path.name.rpartition('-')[0]}-*.ring"):
        with suppress(RingError):  # finished meanwhile
            with Ring.attach(path) as run:
                end_for_dead_loop(run, Ending(ExitCode.UNEXPECTED, reason))
            leave_recorder(path)


def _watch_person() -> int:
    """Wait for the end of standard input; make the rig safe unless all is well."""
    file = read_resolved_rig(json.loads(sys.stdin.buffer.readline()))
    try:
        # Loaded now, because it costs a fraction of a second.
        require_backend(file)
    except RigError as error:
        print(f"watchman: {error}", file=sys.stderr)
        return int(ExitCode.UNAVAILABLE)
    rig = build_safe_rig(file)
    os.write(sys.stdout.fileno(), b"ready\n")
    if sys.stdin.buffer.readline() == _ALL_WELL:
        return int(ExitCode.OK)
    failure = drive_safe(rig)
    return int(ExitCode.OK if failure is None else ExitCode.UNAVAILABLE)


@contextmanager
def keep_watchman(file: RigFile, rig: Rig) -> Iterator[None]:
    """Keep a watchman for the block; it makes the rig safe if this process dies in it.

    The block closes the rig. Raises `RigError` where the watchman cannot work, or where neither
    the block nor the watchman could make the rig safe.
    """
    watchman = subprocess.Popen(
        child_command("pamctl.processes.guardian_main"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    assert watchman.stdin is not None
    assert watchman.stdout is not None
    try:
        with suppress(BrokenPipeError):
            told = json.dumps({"rig": file.model_dump(mode="json", exclude_none=True)})
            watchman.stdin.write(told.encode() + b"\n")
            watchman.stdin.flush()
        if not select.select([watchman.stdout], [], [], STARTS_WITHIN_S)[0]:
            watchman.kill()
            raise RigError(f"the watchman process did not start within {STARTS_WITHIN_S:g} s")
        if watchman.stdout.readline() != b"ready\n":
            raise RigError("the watchman process did not start", fix="see its message above")
        yield
    finally:
        with suppress(BrokenPipeError):
            if rig.safe_failure is None:
                watchman.stdin.write(_ALL_WELL)
            watchman.stdin.close()
        try:
            watchman.wait(_END_PATIENCE_S)
        except subprocess.TimeoutExpired:
            watchman.kill()
            watchman.wait()
            print(f"note: the watchman did not end within {_END_PATIENCE_S:g} s", file=sys.stderr)
        watchman.stdout.close()
    if rig.safe_failure is not None:
        raise rig.safe_failure


if __name__ == "__main__":
    sys.exit(main())
