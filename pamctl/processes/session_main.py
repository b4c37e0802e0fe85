"""The loop process of a daemon: `python -m pamctl.processes.session_main RING ORDERS_FD`.

It takes orders until it is stopped. The ring is the session's own, and nothing records it; each
run brings another ring. The end of its standard input is the daemon's death. Its standard output
is one JSON line: how the session ended.
"""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from functools import partial
from typing import NoReturn

from pamctl.exit_codes import EMERGENCY_STOP, Ending, ExitCode
from pamctl.processes.backends import build_clock, build_rig, make_plant, require_backend
from pamctl.processes.loop_main import (
    await_guardian,
    check_rate,
    free_foreign_threads,
    report_and_exit,
    run_to_ending,
)
from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.clock import LoopSettings
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.orders import Orders
from pamctl.realtime.scheduling import keep_single_threaded, prepare
from pamctl.realtime.steering import SteeredProgram
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.journal import SessionJournal
from pamctl.recording.recorder import leave_recorder
from pamctl.recording.ring import Ring, RingFull
from pamctl.settings.build import build_ordered_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import RunSettings, from_resolved

_EMERGENCY = Ending(ExitCode.SAFETY_TRIP, EMERGENCY_STOP)


class _SessionSupervisor(LoopSupervisor):
    """What ends a session: all that ends a run, and the emergency stop."""

    def __init__(self, ring: Ring, orders: Orders, pace: LoopSettings) -> None:
        super().__init__(ring, sys.stdin.fileno(), pace)
        self._orders = orders

    def wants_abort(self) -> bool:
        return self._orders.emergency or super().wants_abort()

    def find_stop(self, tick: int) -> Ending | None:
        return _EMERGENCY if self._orders.emergency else super().find_stop(tick)


def main() -> NoReturn:
    """Run the session on the ring and with the orders that the arguments name."""
    keep_single_threaded()
    with Ring.attach(sys.argv[1]) as ring:
        orders = Orders(int(sys.argv[2]))
        settings = from_resolved(json.dumps(ring.meta.config))
        supervisor = _SessionSupervisor(ring, orders, settings.rig.loop)
        journal = SessionJournal(ring, supervisor.watch_recording)
        ending = supervisor.name_cause(
            run_to_ending(partial(_run, ring, settings, orders, journal, supervisor))
        )
        recorded = journal.run
        with suppress(RingFull):
            journal.end_last_run(ending)
        ring.loop_done = 1
        if recorded is not None and supervisor.may_be_last():
            leave_recorder(recorded.path)
    report_and_exit(ending)


def _run(
    ring: Ring,
    settings: RunSettings,
    orders: Orders,
    journal: SessionJournal,
    supervisor: _SessionSupervisor,
) -> Ending:
    supervisor.watch_recording(None)
    supervisor.listen()
    # Before this process is scheduled in real time: loading a driver takes long.
    require_backend(settings)
    if (ending := await_guardian(ring, supervisor)) is not None:
        return ending
    with prepare(settings.rt, settings.rig.loop.cpu) as preparation:
        setup = build_tick_setup(settings)
        tick = TickRunner(setup)
        start = {"event": "timing_setup", **preparation.as_metadata(), "tick": tick.way}
        journal.put_event(0, ring.meta.start_mono_ns, start)
        for event in check_rate(settings, setup, tick):
            journal.put_event(0, ring.meta.start_mono_ns, event)
        clock = build_clock(settings, may_spin=preparation.may_spin)
        parts = build_rig(settings, clock, plant=make_plant(settings))
        steered = SteeredProgram(
            orders,
            journal,
            setup,
            settings.controller.model_dump(mode="json"),
            partial(build_ordered_program, settings),
            preparation.defer_page_faults,
        )
        return ControlLoop(
            rig=parts.rig,
            clock=parts.clock,
            setup=setup,
            nominal_zero=nominal_zero_of(settings),
            program=steered,
            journal=journal,
            supervisor=supervisor,
            truth=parts.truth,
            helm=steered,
            opened=partial(free_foreign_threads, preparation),
            tick=tick,
        ).run()


if __name__ == "__main__":
    main()
