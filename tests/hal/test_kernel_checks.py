"""What the doctor reads of the kernel's side of an NI card, over made-up system files."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest
from support.card_rigs import make_pci_card

from hal.nidaq.nidaq_backend import examine_kernel
from hal.problem import Problem


def make_module(dkms: Path, name: str, release: str) -> None:
    (dkms / name / "26.8.0" / release / "x86_64" / "module").mkdir(parents=True)


def examine(place: Path, *, is_clocked: bool = True) -> dict[str, Problem]:
    findings = list(examine_kernel(place / "pci", place / "dkms", is_clocked=is_clocked))
    return {finding.key: finding for finding in findings}


def test_a_card_that_ni_s_driver_holds_is_well(tmp_path: Path) -> None:
    make_pci_card(tmp_path / "pci", "niraptnonusb", iommu="identity")
    make_module(tmp_path / "dkms", "nikal", platform.release())
    found = examine(tmp_path)
    assert {finding.level for finding in found.values()} == {"ok"}
    assert set(found) == {"card.kernel_driver", "card.modules", "card.iommu"}


def test_a_card_that_the_kernel_s_own_driver_took_has_two_ways_out(tmp_path: Path) -> None:
    make_pci_card(tmp_path / "pci", "ni_pcimio")
    found = examine(tmp_path)["card.kernel_driver"]
    assert found.level == "fault"
    assert "0000:05:00.0 (0x70af) is held by ni_pcimio" in found.message
    assert "blacklist ni_pcimio" in found.fix
    assert "--backend comedi" in found.fix


def test_a_card_that_nobody_holds_points_to_the_modules(tmp_path: Path) -> None:
    make_pci_card(tmp_path / "pci", "")
    make_module(tmp_path / "dkms", "nikal", "5.15.0-old")
    make_module(tmp_path / "dkms", "nipalk", platform.release())
    found = examine(tmp_path)
    assert found["card.kernel_driver"].level == "fault"
    assert "card.modules" in found["card.kernel_driver"].fix
    modules = found["card.modules"]
    assert modules.level == "fault"
    assert modules.message == f"not built for kernel {platform.release()}: nikal"
    assert f"linux-headers-{platform.release()}" in modules.fix


def test_without_a_card_on_the_bus_the_doctor_warns_and_says_no_more(tmp_path: Path) -> None:
    found = examine(tmp_path)
    assert [(name, one.level) for name, one in found.items()] == [("card.kernel_driver", "warning")]


@pytest.mark.parametrize(
    ("kind", "is_clocked", "level"),
    [("DMA-FQ", True, "warning"), ("DMA", False, "ok"), ("identity", True, "ok"), ("", True, "ok")],
)
def test_an_iommu_in_the_way_matters_to_a_clocked_card(
    tmp_path: Path, kind: str, is_clocked: bool, level: str
) -> None:
    make_pci_card(tmp_path / "pci", "niraptnonusb", iommu=kind)
    found = examine(tmp_path, is_clocked=is_clocked)["card.iommu"]
    assert found.level == level
    if level == "warning":
        assert "-50152" in found.fix
        assert "iommu=pt" in found.fix
