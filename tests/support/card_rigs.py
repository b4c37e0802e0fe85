"""Rigs over the stand-in card in made-up time, shared by the tests of card and faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from standin.standin import Card, permit

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


def use_card(card: Card) -> Iterator[Card]:
    """Switch a card on, where the tests may use it; mend it afterwards."""
    with permit():
        card.power_up()
        card.calibrate()
        yield card
        card.mend()
        card.registers.is_gone = 0


def make_and_close(card: Card, make: Callable[..., Rig]) -> Iterator[Callable[..., Any]]:
    """Make rigs, and close them whatever the test has done to them."""
    made: list[Rig] = []

    def make_one(**changes: object) -> Rig:
        made.append(make(**changes))
        return made[-1]

    yield make_one
    card.mend()
    card.registers.is_gone = 0
    for rig in made:
        rig.close()


def make_pci_card(
    devices: Path,
    driver: str,
    *,
    slot: str = "0000:05:00.0",
    vendor: str = "0x1093",
    iommu: str = "",
) -> None:
    """Write what the kernel shows of one PCI device; its number is a PCI-6221's."""
    place = devices / slot
    place.mkdir(parents=True)
    (place / "vendor").write_text(f"{vendor}\n")
    (place / "device").write_text("0x70af\n")
    if driver:
        holder = devices.parent / "drivers" / driver
        holder.mkdir(parents=True, exist_ok=True)
        (place / "driver").symlink_to(holder)
    if iommu:
        group = devices.parent / "groups" / "7"
        group.mkdir(parents=True)
        (group / "type").write_text(f"{iommu}\n")
        (place / "iommu_group").symlink_to(group)
