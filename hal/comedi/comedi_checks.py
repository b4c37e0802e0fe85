"""Checks of a card behind comedi for `pamctl doctor`: driver, device file, parts, calibration.

Nothing here loads libcomedi before a check is asked for: a PC without a card need not have it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hal.backend import ProbeRequest
from hal.comedi.comedi_errors import BUSY, PERMIT
from hal.comedi.comedi_settings import UNCALIBRATED, ComediSettings
from hal.doctor_finding import DoctorFinding, describe_rig_error, report_rig_error
from hal.pci_cards import (
    COMEDI_DRIVER,
    NO_CARD_FIX,
    PCI_DEVICES,
    PciCard,
    describe_holders,
    find_pci_cards,
)
from hal.range_checks import judge_input_range
from hal.rig import RigError

if TYPE_CHECKING:
    from hal.comedi.codes import AnalogChannel
    from hal.comedi.libcomedi import ComediFile

REQUIRED = frozenset(
    {"card.driver", "card.device", "card.channels", "card.calibration", "card.reservations"}
)
"""Findings whose fault means that no rig can be opened; other faults leave it usable."""

_PFI_LINES_OF_37_PINS = 8


def examine_comedi(request: ProbeRequest[ComediSettings]) -> Iterator[DoctorFinding]:
    """Check library and driver, then the card and its parts, as far as each step allows."""
    from hal.comedi.comedi_rig import require_card
    from hal.comedi.libcomedi import ComediFile, find_library_path, load_library

    settings = request.settings
    yield judge_kernel_driver(find_pci_cards(PCI_DEVICES))
    try:
        load_library()
    except RigError as error:
        yield report_rig_error("card.driver", error, "libcomedi loaded")
        return
    yield DoctorFinding("card.driver", "ok", f"libcomedi ({find_library_path()})")
    yield from check_permission(Path(settings.device))
    try:
        require_card(settings)
        file = ComediFile(settings.device)
    except RigError as error:
        wanted = "a card behind comedi.device of the rig file"
        yield report_rig_error("card.device", error, wanted)
        return
    with file:
        told = file.describe()
        found = f"{settings.device}: {told['product_type']}, driver {told['driver_name']}"
        yield DoctorFinding("card.device", "ok", found, data=told)
        yield from _examine_parts(file, request, str(told["product_type"]))


def _examine_parts(
    file: ComediFile, request: ProbeRequest[ComediSettings], product: str
) -> Iterator[DoctorFinding]:
    from hal.comedi.codes import list_ranges
    from hal.comedi.comedi_rig import (
        find_counter,
        find_pfi_lines,
        find_pressure_input,
        find_valve_output,
    )

    settings = request.settings
    try:
        sensor = find_pressure_input(file, settings)
        valve = find_valve_output(file, settings)
        counter = find_counter(file, settings)
        find_pfi_lines(file)
    except RigError as error:
        wanted = "as section comedi of the rig file says"
        yield report_rig_error("card.channels", error, wanted)
        return
    yield judge_pfi_lines(settings, product)
    ranges = list_ranges(file, sensor.subdevice, sensor.channel).values()
    asked = (settings.input_low_v, settings.input_high_v)
    yield judge_input_range("comedi", asked, tuple(ranges), request)
    yield judge_calibration(file, settings, sensor, valve)
    yield judge_locks(
        file,
        {
            settings.pressure_channel: sensor.subdevice,
            settings.encoder_counter: counter,
            settings.valve_channel: valve.subdevice,
        },
    )


def judge_kernel_driver(cards: Sequence[PciCard]) -> DoctorFinding:
    """Say which kernel driver holds NI's cards: only one of NI's own and comedi's can."""
    name = "card.kernel_driver"
    wanted = f"a card held by {COMEDI_DRIVER}"
    if not cards:
        return DoctorFinding(name, "warning", "no card of NI's on the PCI bus", wanted, NO_CARD_FIX)
    found = describe_holders(cards)
    data = {"cards": [card._asdict() for card in cards]}
    if any(card.driver == COMEDI_DRIVER for card in cards):
        return DoctorFinding(name, "ok", found, data=data)
    held = next((card.driver for card in cards if card.driver), "")
    fix = (
        f"NI's driver {held} holds it, so comedi cannot: `pamctl manual comedi` shows how to switch"
        if held
        else f"sudo modprobe {COMEDI_DRIVER}"
    )
    return DoctorFinding(name, "fault", found, wanted, fix, data)


def check_permission(device: Path) -> Iterator[DoctorFinding]:
    """Check that this user may use the device file, where there is one."""
    if not device.exists():
        return
    if os.access(device, os.R_OK | os.W_OK):
        yield DoctorFinding("card.permission", "ok", f"access to {device}")
        return
    try:
        group = device.group()
    except KeyError:
        group = str(device.stat().st_gid)
    found = f"no access to {device}, of the group {group}"
    fix = PERMIT.format(device=device).replace("GROUP", group)
    yield DoctorFinding("card.permission", "fault", found, "read and write", fix)


def judge_pfi_lines(settings: ComediSettings, product: str) -> DoctorFinding:
    """Check that the card has terminals for the encoder's lines."""
    lines = (settings.encoder_a_pfi, settings.encoder_b_pfi)
    found = (
        f"{settings.pressure_channel}, {settings.encoder_counter} on PFI {lines[0]} and "
        f"{lines[1]}, {settings.valve_channel}"
    )
    if "37pin" in product and max(lines) >= _PFI_LINES_OF_37_PINS:
        fix = "wire A and B to two of PFI 0 to 7, and set comedi.encoder_a_pfi and encoder_b_pfi"
        return DoctorFinding("card.channels", "fault", found, "PFI 0 to 7 on this card", fix)
    return DoctorFinding("card.channels", "ok", found)


def judge_calibration(
    file: ComediFile, settings: ComediSettings, sensor: AnalogChannel, valve: AnalogChannel
) -> DoctorFinding:
    """Check that the calibration file knows both converters."""
    from hal.comedi.codes import CALIBRATE, read_calibration
    from hal.comedi.libcomedi import FROM_PHYSICAL, TO_PHYSICAL

    name, wanted = "card.calibration", "a file from comedi_soft_calibrate"
    if settings.calibration_file == UNCALIBRATED:
        found = "comedi.calibration_file: none: nominal ranges, wrong by some 5 %"
        fix = CALIBRATE.format(device=settings.device).partition(";")[0]
        return DoctorFinding(name, "warning", found, wanted, fix)
    try:
        with read_calibration(file, settings.calibration_file) as calibration:
            calibration.get_polynomial(file, sensor, TO_PHYSICAL)
            calibration.get_polynomial(file, valve, FROM_PHYSICAL)
    except RigError as error:
        return report_rig_error(name, error, wanted)
    return DoctorFinding(name, "ok", calibration.path)


def judge_locks(file: ComediFile, parts: dict[str, int]) -> DoctorFinding:
    """Take each part of the card for a moment; say which of them another program holds."""
    busy: dict[str, RigError] = {}
    for part, subdevice in parts.items():
        try:
            file.lock(subdevice, part)
        except RigError as error:
            busy[part] = error
        else:
            file.unlock(subdevice)
    name = "card.reservations"
    if not busy:
        return DoctorFinding(name, "ok", "input, counter and output are free")
    found = "; ".join(describe_rig_error(error) for error in busy.values())
    fix = next(iter(busy.values())).fix
    if all(error.code in BUSY for error in busy.values()):
        fix = f"{fix}; sudo fuser -v {file.path} names it"
    return DoctorFinding(name, "fault", found, "free", fix, {"channels": sorted(busy)})
