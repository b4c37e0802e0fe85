"""The guardian process: `python -m pamctl.processes.guardian_main RING`, started by the front.

All it needs is in the ring's meta. The end of its standard input is the front's death. Its
standard output is one JSON line: what it had to do. Signals do not end it: it stays as long as
the loop does, and then until the front has finished the log.
"""

from __future__ import annotations

import json
import select
import sys
import time
from contextlib import suppress

from hal.rig import RigError
from pamctl.exit_codes import Ending, ExitCode
from pamctl.processes.backends import build_clock, build_rig
from pamctl.processes.finisher_main import start_finisher
from pamctl.processes.guardian import LoopProcess, Takeover, drive_safe, guard
from pamctl.processes.loop_supervisor import STARTS_WITHIN_S
from pamctl.realtime.scheduling import keep_single_threaded, prepare_guardian
from pamctl.recording.last_words import make_outcome_event, put_event_for_dead_loop
from pamctl.recording.recorder import outlive_signals
from pamctl.recording.ring import Ring, RingError
from pamctl.settings.resolve import from_resolved


def main() -> int:
    """Guard the loop of the ring that the first argument names; return the exit code."""
    outlive_signals()
    keep_single_threaded()
    with Ring.attach(sys.argv[1]) as ring:
        try:
            takeover = _guard(ring)
        except RigError as error:
            print(f"guardian: {error}", file=sys.stderr)
            return int(ExitCode.UNAVAILABLE)
        if takeover is not None:
            put_event_for_dead_loop(ring, takeover.event())
        with suppress(BrokenPipeError):  # the front may be dead
            print(json.dumps(takeover and takeover._asdict()), flush=True)
        while not _front_is_gone(within_ms=1000):
            pass
        _end_log(ring, takeover)
    return int(ExitCode.OK)


def _guard(ring: Ring) -> Takeover | None:
    settings = from_resolved(json.dumps(ring.meta.config))
    rig = build_rig(settings, build_clock(settings, may_spin=False)).rig
    # A rehearsal before the loop opens the rig: a guardian that cannot make it safe now cannot do
    # so later. It also loads the driver, which would cost a fraction of a second later.
    failure = drive_safe(rig, patience_s=1.0)
    if failure is not None:
        raise failure
    loop = LoopProcess(_await_loop_pid(ring))
    prepare_guardian(settings.rt, settings.rig.loop.cpu)
    ring.guardian_ready = 1
    pace = settings.rig.loop
    return guard(ring, loop, rig, round(pace.heartbeat_ms * 1e6), round(pace.starved_ms * 1e6))


def _await_loop_pid(ring: Ring) -> int:
    """Wait for the front to start the loop."""
    deadline_s = time.monotonic() + STARTS_WITHIN_S
    while not ring.loop_pid:
        # A loop without a guardian that is ready never opens the rig: leaving is safe.
        if _front_is_gone() or time.monotonic() > deadline_s:
            raise RigError("there is no loop to guard")
        time.sleep(1e-3)
    return ring.loop_pid


def _front_is_gone(within_ms: int = 0) -> bool:
    front = select.poll()
    front.register(sys.stdin.fileno(), select.POLLHUP | select.POLLERR)
    return bool(front.poll(within_ms))


def _end_log(ring: Ring, takeover: Takeover | None) -> None:
    """Do what a front does that has died before it has finished the log and removed the ring.

    A daemon's guardian holds the ring of the session. The runs' own rings have names that begin
    with the same process id.
    """
    reason = (takeover and takeover.reason) or "the loop process died"
    for path in ring.path.parent.glob(f"{ring.path.name.rpartition('-')[0]}-*.ring"):
        with suppress(RingError):  # finished meanwhile
            with Ring.attach(path) as run:
                if not run.loop_done:
                    ending = Ending(ExitCode.UNEXPECTED, reason)
                    put_event_for_dead_loop(run, make_outcome_event(ending))
                    run.loop_done = 1
            start_finisher(path)


if __name__ == "__main__":
    sys.exit(main())
