"""What an experiment file asks for beside the reference: marks in the log, and other gains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from hal.rig import RawSample
from pamctl.control.law_registry import read_controller
from pamctl.realtime.gain_ramp import SHORTEST_RAMP_S, GainRamp
from pamctl.realtime.program import Program
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_runner import TickRunner
from pamctl.signals import Timing


class CueJournal(Protocol):
    """Takes the marks and the gains of a run."""

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Keep an event; its key `event` names it."""

    def put_gains(self, tick: int, t_ns: int, gains: Mapping[str, object]) -> None:
        """Keep gains that apply from the next tick on."""


class OrderSlot(Protocol):
    """Where orders come from."""

    def take(self) -> dict[str, Any] | None:
        """Return the next order, or None."""


class CuedHelm:
    """The helm of a single run: it does what the course has due, in the slack after a tick."""

    def __init__(
        self,
        setup: TickSetup,
        controller: Mapping[str, Any],
        program: Program,
        journal: CueJournal,
        orders: OrderSlot | None = None,
    ) -> None:
        """Begin with the gains of `setup`; `controller` holds them as a file does.

        Marks from outside come from `orders`.
        """
        self._orders = orders
        self._tuning = GainRamp(setup, read_controller(controller))
        self._controller = controller
        self._program = program
        self._journal = journal

    def setup(self, t_s: float) -> TickSetup:
        """Return the set-up with the gains of the moment."""
        return self._tuning.at(t_s)

    @property
    def settled_setup(self) -> TickSetup | None:
        """The set-up of the next tick, whenever it is; None while gains are on a ramp."""
        return self._tuning.settled_setup

    def finish_tick(self, done: TickRunner) -> None:
        """Put the marks that are due, and change the gains from the next tick on."""
        timing = done.timing
        order = self._orders.take() if self._orders is not None else None
        if order is not None:
            put_mark(self._journal, timing, done.raw, order["text"])
        while (cue := self._program.take_cue(timing.t_s)) is not None:
            raw = done.raw
            if cue.gains is None:
                put_mark(self._journal, timing, raw, cue.mark)
                continue
            self._controller = {**self._controller, **cue.gains}
            said = say_gain_change(self._controller, timing.t_s, cue.ramp_s)
            self._tuning.change(read_controller(self._controller), timing.t_s, said["ramp_s"])
            self._journal.put_gains(timing.tick, raw.encoder_t_ns, said)


def put_mark(journal: CueJournal, timing: Timing, raw: RawSample, text: str) -> None:
    """Put a remark into the log."""
    journal.put_event(timing.tick, raw.encoder_t_ns, {"event": "mark", "text": text})


def say_gain_change(controller: Mapping[str, Any], t_s: float, ramp_s: float) -> dict[str, Any]:
    """Return gains as the log holds them: all that a replay of their ramp needs."""
    return {**controller, "from_t_s": t_s, "ramp_s": max(ramp_s, SHORTEST_RAMP_S)}
