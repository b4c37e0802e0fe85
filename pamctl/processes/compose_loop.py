"""The one place where a loop is composed: of a run, of a session, or of a run in this process."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial

from pamctl.exit_codes import Ending
from pamctl.offline.many_ticks import find_many_ticks
from pamctl.processes.backends import build_clock, build_rig, make_plant
from pamctl.realtime.loop import ControlLoop, Supervisor
from pamctl.realtime.program import CuedHelm, OrderSlot, Program
from pamctl.realtime.scheduling import Preparation
from pamctl.realtime.steering import SteeredProgram
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_runner import TickCost, TickRunner, rehearse_tick_s
from pamctl.recording.journal import RingJournal, SessionJournal
from pamctl.settings.build import (
    build_ordered_program,
    build_program,
    build_tick_setup,
    nominal_zero_of,
)
from pamctl.settings.resolve import RunSettings

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
