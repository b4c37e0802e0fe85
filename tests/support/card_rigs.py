"""Rigs over the stand-in card in made-up time, shared by the tests of card and faults."""

from __future__ import annotations

from collections.abc import Callable

from standin.standin import Card

from hal.nidaq.card_settings import NidaqSettings
from hal.rig import Rig
from pamctl.realtime.clock import Clock, SampleClock, VirtualClock, Wake
from support.runs import MS

READ_VOLTS = "DAQmxReadAnalogScalarF64"
READ_COUNT = "DAQmxReadCounterScalarF64"
WRITE = "DAQmxWriteAnalogScalarF64"


class CardClock(VirtualClock):
    """Sets the card's time to its own, so that both stand still within a tick."""

    def __init__(self, card: Card) -> None:
        super().__init__(MS)
        self._card = card

    def wait(self, rehearse: Callable[[], None] | None = None) -> Wake:
        wake = super().wait()
        self._card.set_time_ns(wake.now_ns)
        return wake


class CardTime(VirtualClock):
    """Reads the time of a card that sets it itself."""

    def __init__(self, card: Card) -> None:
        super().__init__(MS)
        self._card = card

    def now_ns(self) -> int:
        return self._card.now_ns()


def on_demand(card: Card, safe_output_v: float) -> tuple[Rig, Clock]:
    from hal.nidaq.nidaq_rig import NidaqRig

    clock = CardClock(card)
    return NidaqRig(NidaqSettings(), safe_output_v=safe_output_v, now_ns=clock.now_ns), clock


def hardware_timed(card: Card, safe_output_v: float) -> tuple[Rig, Clock]:
    from hal.nidaq.nidaq_rig import HardwareTimedRig

    time, wiring = CardTime(card), NidaqSettings(timing="hardware_timed")
    rig = HardwareTimedRig(wiring, rate_hz=1e3, safe_output_v=safe_output_v, now_ns=time.now_ns)
    return rig, SampleClock(time, rig.await_edge)
