"""The loop process: `python -m pamctl.processes.loop_main RING [session]`.

The front of a run starts it on the ring of that run, a daemon on the ring of its session, which
nothing records: there each run brings another ring. All that it needs is in the ring's meta; marks
or orders come from the ring's slot. The end of its standard input is the death of who started it.
It says in JSON lines on standard output how it ends: once when the valve is safe, and once when all
is done. The last line counts.

This is the one place where a loop is composed: of a run, of a session, or of a run in one process.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from functools import partial
from typing import NoReturn

from hal.rig import RigError
from pamctl.base.errors import Ending, ExitCode
from pamctl.processes.backends import build_clock, build_rig, make_plant, require_backend
from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.loop import ControlLoop, Supervisor
from pamctl.realtime.many_ticks import find_many_ticks
from pamctl.realtime.orders import Orders
from pamctl.realtime.program import CuedHelm, OrderSlot, Program
from pamctl.realtime.scheduling import Preparation, SchedulingError, keep_single_threaded, prepare
from pamctl.realtime.steering import SteeredProgram
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_runner import TickCost, TickRunner, rehearse_tick_s
from pamctl.recording.journal import RingJournal, SessionJournal
from pamctl.recording.recorder import leave_recorder
from pamctl.recording.ring import RecorderFlag, Ring, RingError
from pamctl.settings.build import (
    build_ordered_program,
    build_program,
    build_tick_setup,
    nominal_zero_of,
)
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


# --- how a loop is composed ---------------------------------------------------------------------

_UNPREPARED = Preparation("off", (), ExitStack())


def compose_loop(
    settings: RunSettings,
    journal: RingJournal,
    supervisor: Supervisor,
    orders: OrderSlot | None = None,
    preparation: Preparation = _UNPREPARED,
    ended: Callable[[Ending], None] = lambda ending: None,
) -> ControlLoop:
    """Return a loop that is ready to run, and note in the journal what every log begins with.

    With a `SessionJournal` the loop outlives its runs and lives by its `orders`; else it does the
    one run of `settings`, and `orders` bring marks. `preparation` says how this process is
    scheduled; `ended` is told the ending as soon as the valve is safe. Raise `RigError`.
    """
    setup = build_tick_setup(settings)
    tick = TickRunner(setup)
    timing = {**preparation.as_metadata(), "tick": tick.way}
    if settings.fast:
        timing = {"mode": "fast: no clock"}
    journal.note_start({"event": "timing_setup", **timing})
    for event in () if settings.fast else check_rate(settings, setup, tick):
        journal.note_start(event)
    clock = build_clock(settings, may_spin=preparation.may_spin)
    parts = build_rig(settings, clock, plant=make_plant(settings))
    controller = settings.controller.model_dump(mode="json")
    program: Program | SteeredProgram
    helm: CuedHelm | SteeredProgram
    if isinstance(journal, SessionJournal):
        assert orders is not None
        program_of = partial(build_ordered_program, settings)
        program = helm = SteeredProgram(
            orders, journal, setup, controller, program_of, preparation.defer_page_faults
        )
        many = None  # whoever orders looks at every tick
    else:
        journal.put_gains(0, journal.start_ns, controller)
        program = build_program(settings)
        helm = CuedHelm(setup, controller, program, journal, orders)
        many = find_many_ticks(setup, parts.rig, parts.clock)
    return ControlLoop(
        rig=parts.rig,
        clock=parts.clock,
        setup=setup,
        nominal_zero=nominal_zero_of(settings),
        program=program,
        journal=journal,
        supervisor=supervisor,
        truth=parts.truth,
        helm=helm,
        opened=partial(_free_foreign_threads, preparation),
        tick=tick,
        many=many,
        ended=ended,
    )


def check_rate(
    settings: RunSettings, setup: TickSetup, tick: TickRunner | None = None
) -> list[dict[str, object]]:
    """Warn of a rate that this PC cannot hold; return what to note in the log.

    Call it in the loop's process as it is scheduled, before the rig is open.
    """
    rate_hz = settings.rig.loop.rate_hz
    cost = TickCost.estimate(rehearse_tick_s(setup, 1.0 / rate_hz, tick=tick))
    warning = cost.find_warning(rate_hz)
    if not warning:
        return []
    with suppress(OSError):  # nobody may be there to read it; the log has it
        print(f"warning: {warning}", file=sys.stderr, flush=True)
    return [{"event": "rate_warning", "detail": warning, **cost._asdict()}]


def _free_foreign_threads(preparation: Preparation) -> list[dict[str, object]]:
    """Free the threads of the rig's driver; return what to note in the log."""
    steps = preparation.free_foreign_threads()
    return [{"event": step.name, "done": step.done, "detail": step.detail} for step in steps]


if __name__ == "__main__":
    main()
