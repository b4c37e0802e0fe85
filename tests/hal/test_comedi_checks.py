"""`pamctl doctor` on a card: each fault is found, named, and comes with its fix."""

import errno
import os
import platform
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from standin.standin import Card, here_behind_comedi
from support.card_rigs import make_pci_card, use_card

from hal.card import PciCard, find_pci_cards
from hal.comedi import comedi_backend, libcomedi
from hal.comedi.comedi_backend import (
    REQUIRED,
    ComediSettings,
    check_permission,
    examine_comedi,
    judge_kernel_driver,
    judge_pfi_lines,
)
from hal.comedi.comedi_rig import ComediRig
from hal.nidaq.nidaq_backend import examine_kernel
from hal.problem import Problem
from pamctl.commissioning.rig_checks import make_probe_request
from pamctl.settings.resolve import resolve

Examine = Callable[..., dict[str, Problem]]


@pytest.fixture
def card() -> Iterator[Card]:
    yield from use_card(here_behind_comedi())


@pytest.fixture
def examine(card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Examine:
    """Examine the card in a PC whose driver `ni_pcimio` holds it."""
    make_pci_card(tmp_path / "devices", "ni_pcimio")
    monkeypatch.setattr(comedi_backend, "PCI_DEVICES", tmp_path / "devices")

    def examine_one(*overrides: str) -> dict[str, Problem]:
        settings = resolve(rig="pci6221-comedi", overrides=list(overrides))
        findings = list(examine_comedi(make_probe_request(settings)))
        assert len({finding.key for finding in findings}) == len(findings)
        return {finding.key: finding for finding in findings}

    return examine_one


def test_a_sound_card_has_nothing_but_ok(examine, card):
    found = examine()
    assert {finding.level for finding in found.values()} == {"ok"}
    assert set(found) == REQUIRED | {"card.kernel_driver", "card.input_range"}
    assert card.written_v == []  # the doctor looks, and writes nothing
    assert "ni_pcimio" in found["card.kernel_driver"].message
    assert "PFI 8 and 10" in found["card.channels"].message
    assert "24 Pa a code" in found["card.input_range"].message


# --- the kernel's driver -----------------------------------------------------------------


def test_only_ni_s_cards_are_listed_each_with_its_driver(tmp_path):
    make_pci_card(tmp_path / "devices", "")
    make_pci_card(tmp_path / "devices", "ni_pcimio", slot="0000:04:00.0")
    make_pci_card(tmp_path / "devices", "i915", slot="0000:00:02.0", vendor="0x8086")
    assert find_pci_cards(tmp_path / "devices") == [
        PciCard("0000:04:00.0", "0x70af", "ni_pcimio"),
        PciCard("0000:05:00.0", "0x70af", ""),
    ]
    assert find_pci_cards(tmp_path / "not there") == []


@pytest.mark.parametrize(
    ("drivers", "level", "fix"),
    [
        (["ni_pcimio"], "ok", ""),
        (["nimxs", "ni_pcimio"], "ok", ""),
        (["nimxs"], "fault", "NI's driver nimxs holds it"),
        ([""], "fault", "modprobe ni_pcimio"),
        ([], "warning", "seated"),
    ],
)
def test_the_driver_that_holds_the_card_is_named_with_the_way_out(drivers, level, fix):
    cards = [PciCard(f"0000:0{i}:00.0", "0x70af", driver) for i, driver in enumerate(drivers)]
    finding = judge_kernel_driver(cards)
    assert finding.level == level
    assert fix in finding.fix


# --- library, device file, permission ----------------------------------------------------


def test_without_the_library_the_doctor_says_what_to_install_and_looks_no_further(
    examine, monkeypatch
):
    monkeypatch.setattr(libcomedi, "SONAME", "libcomedi-that-is-not-there.so")
    monkeypatch.setattr(comedi_backend, "load_library", libcomedi.load_library.__wrapped__)
    found = examine()
    assert set(found) == {"card.kernel_driver", "card.driver"}
    assert found["card.driver"].level == "fault"
    assert "apt install libcomedi0" in found["card.driver"].fix


def test_a_device_file_that_is_not_there_is_a_fault(examine):
    found = examine("rig.comedi.device=/dev/comedi9")
    assert found["card.device"].level == "fault"
    assert "No such file" in found["card.device"].message
    assert "card.channels" not in found


def test_a_file_without_permission_names_its_group(tmp_path, monkeypatch):
    device = tmp_path / "comedi0"
    assert list(check_permission(device)) == []
    device.touch()
    assert [finding.level for finding in check_permission(device)] == ["ok"]
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may do everything
    (finding,) = check_permission(device)
    assert finding.level == "fault"
    assert f"usermod -aG {device.group()} $USER" in finding.fix


# --- the card's parts --------------------------------------------------------------------


def test_a_channel_that_the_card_does_not_have_is_a_fault(examine):
    found = examine("rig.comedi.pressure_channel=ai20")
    assert found["card.channels"].level == "fault"
    assert "one of the card's 16" in found["card.channels"].message


def test_lines_that_the_37_pin_card_does_not_have_are_a_fault():
    assert judge_pfi_lines(ComediSettings(), "pci-6221").level == "ok"
    finding = judge_pfi_lines(ComediSettings(), "pci-6221_37pin")
    assert finding.level == "fault"
    assert "PFI 0 to 7" in finding.fix
    low = ComediSettings(encoder_a_pfi=0, encoder_b_pfi=7)
    assert judge_pfi_lines(low, "pci-6221_37pin").level == "ok"


def test_an_input_range_that_hides_a_broken_wire_is_a_fault(examine):
    found = examine("rig.comedi.input_low_v=0.15", "rig.comedi.input_high_v=1")
    assert found["card.input_range"].level == "fault"
    assert "set comedi.input_low_v to -5" in found["card.input_range"].fix


def test_a_missing_calibration_is_a_fault_and_a_disabled_one_a_warning(examine, card):
    card.calibration_path.unlink()
    finding = examine()["card.calibration"]
    assert finding.level == "fault"
    assert "comedi_soft_calibrate" in finding.fix
    finding = examine("rig.comedi.calibration_file=none")["card.calibration"]
    assert finding.level == "warning"
    assert "5 %" in finding.message


def test_a_part_that_another_file_has_locked_is_named(examine, card):
    rig = ComediRig(ComediSettings(), safe_output_v=0.0)
    rig.open()
    try:
        finding = examine()["card.reservations"]
    finally:
        rig.close()
    assert finding.level == "fault"
    assert finding.data == {"channels": ["ai0", "ao0", "ctr0"]}
    assert "fuser -v /dev/comedi0" in finding.fix
    assert examine()["card.reservations"].level == "ok"


def test_a_part_that_fails_otherwise_is_not_called_busy(examine, card):
    card.fail("comedi_lock", -errno.EIO)
    finding = examine()["card.reservations"]
    assert finding.level == "fault"
    assert "fuser" not in finding.fix


# --- the kernel ----------------------------------------------------------------------------------


def make_module(dkms: Path, name: str, release: str) -> None:
    (dkms / name / "26.8.0" / release / "x86_64" / "module").mkdir(parents=True)


def examine_driver(place: Path, *, is_clocked: bool = True) -> dict[str, Problem]:
    findings = list(examine_kernel(place / "pci", place / "dkms", is_clocked=is_clocked))
    return {finding.key: finding for finding in findings}


def test_a_card_that_ni_s_driver_holds_is_well(tmp_path):
    make_pci_card(tmp_path / "pci", "niraptnonusb", iommu="identity")
    make_module(tmp_path / "dkms", "nikal", platform.release())
    found = examine_driver(tmp_path)
    assert {finding.level for finding in found.values()} == {"ok"}
    assert set(found) == {"card.kernel_driver", "card.modules", "card.iommu"}


def test_a_card_that_the_kernel_s_own_driver_took_has_two_ways_out(tmp_path):
    make_pci_card(tmp_path / "pci", "ni_pcimio")
    found = examine_driver(tmp_path)["card.kernel_driver"]
    assert found.level == "fault"
    assert "0000:05:00.0 (0x70af) is held by ni_pcimio" in found.message
    assert "blacklist ni_pcimio" in found.fix
    assert "--backend comedi" in found.fix


def test_a_card_that_nobody_holds_points_to_the_modules(tmp_path):
    make_pci_card(tmp_path / "pci", "")
    make_module(tmp_path / "dkms", "nikal", "5.15.0-old")
    make_module(tmp_path / "dkms", "nipalk", platform.release())
    found = examine_driver(tmp_path)
    assert found["card.kernel_driver"].level == "fault"
    assert "card.modules" in found["card.kernel_driver"].fix
    modules = found["card.modules"]
    assert modules.level == "fault"
    assert modules.message == f"not built for kernel {platform.release()}: nikal"
    assert f"linux-headers-{platform.release()}" in modules.fix


def test_without_a_card_on_the_bus_the_doctor_warns_and_says_no_more(tmp_path):
    found = examine_driver(tmp_path)
    assert [(name, one.level) for name, one in found.items()] == [("card.kernel_driver", "warning")]


@pytest.mark.parametrize(
    ("kind", "is_clocked", "level"),
    [("DMA-FQ", True, "warning"), ("DMA", False, "ok"), ("identity", True, "ok"), ("", True, "ok")],
)
def test_an_iommu_in_the_way_matters_to_a_clocked_card(tmp_path, kind, is_clocked, level):
    make_pci_card(tmp_path / "pci", "niraptnonusb", iommu=kind)
    found = examine_driver(tmp_path, is_clocked=is_clocked)["card.iommu"]
    assert found.level == level
    if level == "warning":
        assert "-50152" in found.fix
        assert "iommu=pt" in found.fix
