"""NI's cards on the PCI bus, and which kernel driver holds each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

PCI_DEVICES = Path("/sys/bus/pci/devices")
COMEDI_DRIVER = "ni_pcimio"
"""The kernel's own driver. It takes a PCI-6221 by itself when the PC starts."""
NO_CARD_FIX = "is the card seated and powered? lspci -nn -d 1093: lists it"

_NI = "0x1093"


class PciCard(NamedTuple):
    """One of NI's cards, as the kernel sees it."""

    slot: str
    """Such as 0000:05:00.0."""
    device_id: str
    """Such as 0x70af."""
    driver: str
    """Name of the kernel driver that holds it; empty where none does."""


def find_pci_cards(directory: Path = PCI_DEVICES) -> list[PciCard]:
    """Return NI's cards in the order of their slots; none where the system has no such place."""
    slots = sorted(directory.iterdir()) if directory.is_dir() else []
    return [
        PciCard(slot.name, _read(slot / "device"), _find_driver(slot))
        for slot in slots
        if _read(slot / "vendor") == _NI
    ]


def describe_holders(cards: Sequence[PciCard]) -> str:
    """Say which driver holds each card."""
    return "; ".join(
        f"{card.slot} ({card.device_id}) is held by {card.driver or 'no driver'}" for card in cards
    )


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def _find_driver(slot: Path) -> str:
    link = slot / "driver"
    return link.resolve().name if link.exists() else ""
