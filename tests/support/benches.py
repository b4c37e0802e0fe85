"""Benches of `doctor` and `calibrate`, and rigs that are plumbed wrongly, in made-up time."""

from __future__ import annotations

from typing import Any

from standin.standin import Card

from hal.rig import Rig
from pamctl.commissioning.bench import Bench
from pamctl.plant.simulated import SimulatedPlant
from pamctl.realtime.clock import Clock
from pamctl.settings.resolve import RunSettings
from support.card_rigs import CardClock


def bench_of(settings: RunSettings, rig: Any, clock: Clock) -> Bench:
    """Open a rig, and return a bench of it by the rig file."""
    rig.open()
    return Bench(rig, clock, settings.rig)


def card_rig(card: Card, settings: RunSettings) -> tuple[Rig, CardClock]:
    """Return the rig of a card by its rig file, and a clock that takes the card's time along."""
    from hal.nidaq.nidaq_rig import NidaqRig

    card.stop_time()
    clock = CardClock(card)
    wiring: Any = settings.rig.nidaq  # type: ignore[union-attr]
    return NidaqRig(wiring, safe_output_v=0.0, now_ns=clock.now_ns), clock


class Reversed(SimulatedPlant):
    """A valve plumbed the wrong way."""

    def advance(self, command_v: float, duration_s: float) -> None:
        super().advance(-command_v, duration_s)


class Unsupplied(SimulatedPlant):
    """A supply that is shut."""

    def advance(self, command_v: float, duration_s: float) -> None:
        super().advance(min(command_v, 0.0), duration_s)
