"""The loop process: `python -m pamctl.processes.loop_main RING [session]`.

The front of a run starts it on the ring of that run, a daemon on the ring of its session, which
nothing records: there each run brings another ring. All that it needs is in the ring's meta; marks
or orders come from the ring's slot. The end of its standard input is the death of who started it.
It says in JSON lines on standard output how it ends: once when the valve is safe, and once when all
is done. The last line counts.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from typing import NoReturn

from hal.rig import RigError
from pamctl.exit_codes import Ending, ExitCode
from pamctl.processes.backends import require_backend
from pamctl.processes.compose_loop import compose_loop
from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.orders import Orders
from pamctl.realtime.scheduling import SchedulingError, keep_single_threaded, prepare
from pamctl.recording.journal import (
    RingJournal,
    SessionJournal,
)
from pamctl.recording.recorder import leave_recorder
from pamctl.recording.ring import RecorderFlag, Ring, RingError
from pamctl.settings.resolve import RunSettings, from_resolved


def main() -> NoReturn:
    """Run the loop on the ring that the first argument names."""
    keep_single_threaded()
    with Ring.attach(sys.argv[1]) as ring, closing(Orders(ring.slot)) as slot:
        settings = from_resolved(json.dumps(ring.meta.config))
        orders = slot if ring.slot_bytes else None
        pace, front = settings.rig.loop, sys.stdin.fileno()
        supervisor = LoopSupervisor(ring, front, pace, orders=orders)
        session = SessionJournal(ring, supervisor.watch_recording) if sys.argv[2:] else None
        journal = session or RingJournal(ring)
        ending = supervisor.name_cause(
            run_to_ending(partial(_run, ring, settings, supervisor, journal, orders))
        )
        recorded = journal.run
        journal.end_last_run(ending)
        if recorded is not None and supervisor.may_be_last():
            leave_recorder(recorded.path)
    tell_parent(ending)
    sys.exit(int(ending.code))


def tell_parent(ending: Ending) -> None:
    """Tell the parent in one JSON line how the run ends."""
    # The parent may be dead.
    with suppress(BrokenPipeError):
        print(json.dumps({"code": int(ending.code), "reason": ending.reason}), flush=True)


def run_to_ending(work: Callable[[], Ending]) -> Ending:
    """Do the work; turn every exception into an ending."""
    try:
        return work()
    except (RigError, SchedulingError) as error:
        return Ending(ExitCode.UNAVAILABLE, str(error))
    except RingError as error:
        return Ending(ExitCode.UNEXPECTED, str(error))
    except Exception as error:
        import traceback

        traceback.print_exc()
        return Ending(ExitCode.UNEXPECTED, f"{type(error).__name__}: {error}")


def _run(
    ring: Ring,
    settings: RunSettings,
    supervisor: LoopSupervisor,
    journal: RingJournal,
    orders: Orders | None,
) -> Ending:
    supervisor.listen()
    if isinstance(journal, SessionJournal):
        supervisor.watch_recording(None)
    elif (ending := _await_recorder(ring, supervisor)) is not None:
        return ending
    # Before this process is scheduled in real time: loading a driver takes long.
    require_backend(settings.rig)
    if (ending := _await_guardian(ring, supervisor)) is not None:
        return ending
    with prepare(settings.rt, settings.rig.loop.cpu) as preparation:
        return compose_loop(settings, journal, supervisor, orders, preparation, tell_parent).run()


def _await_recorder(ring: Ring, supervisor: LoopSupervisor) -> Ending | None:
    """Wait until the log is open: no tick may run that could not be recorded."""
    return supervisor.await_start(
        "recorder",
        lambda: bool(ring.recorder_flags & RecorderFlag.READY),
        lambda: bool(ring.recorder_flags & RecorderFlag.FAILED),
    )


def _await_guardian(ring: Ring, supervisor: LoopSupervisor) -> Ending | None:
    """Wait for the guardian: no valve may move that nobody could close."""
    return supervisor.await_start(
        "guardian", lambda: bool(ring.guardian_ready), lambda: bool(ring.guardian_lost)
    )


if __name__ == "__main__":
    main()
