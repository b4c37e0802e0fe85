"""What the kernel says of an NI card: who holds it, whether NI's modules fit, the IOMMU.

Read from the file system, before NI's driver is loaded: where the kernel's side is wrong, NI's
own tools see no card and do not say why.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from hal.doctor_finding import DoctorFinding
from hal.pci_cards import (
    COMEDI_DRIVER,
    NO_CARD_FIX,
    PCI_DEVICES,
    PciCard,
    describe_holders,
    find_pci_cards,
)

DKMS_TREE = Path("/var/lib/dkms")
"""Where DKMS keeps the modules that it builds for each kernel."""

_TRANSLATED = "DMA"
"""Types of an IOMMU group that begin so translate every address that the card uses."""
_IOMMU_FIX = (
    "if a clocked task fails with -50152: `sudo dmesg` then shows DMAR, AMD-Vi or IO_PAGE_FAULT; "
    "start the PC with iommu=pt. On demand works either way"
)


class Module(NamedTuple):
    """A kernel module of NI's that DKMS knows."""

    name: str
    is_built: bool
    """For the running kernel."""


def examine_kernel(
    pci: Path = PCI_DEVICES, dkms: Path = DKMS_TREE, *, is_clocked: bool
) -> Iterator[DoctorFinding]:
    """Check who holds the card, whether NI's modules are built, and the IOMMU."""
    cards, release = find_pci_cards(pci), platform.release()
    modules = find_modules(dkms, release)
    yield judge_holder(cards)
    if modules:
        yield judge_modules(modules, release)
    if cards:
        yield judge_iommu(
            {card.slot: read_iommu_type(pci / card.slot) for card in cards}, is_clocked
        )


def judge_holder(cards: Sequence[PciCard]) -> DoctorFinding:
    """Say which kernel driver holds NI's cards: only one of NI's own and comedi's can."""
    name, wanted = "card.kernel_driver", "a card held by NI's driver"
    if not cards:
        found = "no card of NI's on the PCI bus (a card on USB is not listed there)"
        return DoctorFinding(name, "warning", found, wanted, NO_CARD_FIX)
    found = describe_holders(cards)
    data = {"cards": [card._asdict() for card in cards]}
    if any(card.driver not in ("", COMEDI_DRIVER) for card in cards):
        return DoctorFinding(name, "ok", found, data=data)
    fix = (
        "the kernel's own driver took it, so NI's tools see nothing: write `blacklist ni_pcimio` "
        "to /etc/modprobe.d/ni_pcimio.conf and restart the PC; or use --backend comedi"
        if any(card.driver == COMEDI_DRIVER for card in cards)
        else "NI's modules are not loaded: see card.modules, and `sudo dmesg`, which names modules "
        "that secure boot refused"
    )
    return DoctorFinding(name, "fault", found, wanted, fix, data)


def find_modules(dkms: Path, release: str) -> list[Module]:
    """Return NI's modules that DKMS knows, and whether each is built for the running kernel."""
    sources = sorted(dkms.glob("ni*")) if dkms.is_dir() else []
    return [Module(one.name, any(one.glob(f"*/{release}/*/module"))) for one in sources]


def judge_modules(modules: Sequence[Module], release: str) -> DoctorFinding:
    """Check that DKMS has built NI's modules for the running kernel."""
    name, data = "card.modules", {"modules": [module._asdict() for module in modules]}
    missing = [module.name for module in modules if not module.is_built]
    if not missing:
        found = f"{len(modules)} modules of NI's are built for kernel {release}"
        return DoctorFinding(name, "ok", found, data=data)
    return DoctorFinding(
        name,
        "fault",
        f"not built for kernel {release}: {', '.join(missing)}",
        "all modules of NI's that DKMS knows",
        f"sudo apt install linux-headers-{release}; sudo dkms autoinstall; restart the PC. Where "
        "that fails, start a kernel that NI supports: `dkms status` lists those built for",
        data,
    )


def read_iommu_type(slot: Path) -> str:
    """Return how the IOMMU treats a card, such as identity or DMA-FQ; empty without one."""
    try:
        return (slot / "iommu_group" / "type").read_text().strip()
    except OSError:
        return ""


def judge_iommu(types: dict[str, str], is_clocked: bool) -> DoctorFinding:
    """Say whether the IOMMU stands between card and memory: clocked tasks failed on such PCs."""
    name, data = "card.iommu", {"types": types}
    translated = [slot for slot, kind in types.items() if kind.startswith(_TRANSLATED)]
    if not translated:
        return DoctorFinding(name, "ok", "not between card and memory", data=data)
    found = f"translates the addresses of {', '.join(translated)}"
    wanted = "no IOMMU between card and memory, for nidaq.timing: hardware_timed"
    if is_clocked:
        return DoctorFinding(name, "warning", found, wanted, _IOMMU_FIX, data)
    return DoctorFinding(name, "ok", f"{found}; on demand needs no transfers", data=data)
