"""The record of a card behind comedi: its section of a rig file, and its checks for the doctor.

libcomedi is loaded only where the card is really needed: a PC without a card need not have it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Self

from pydantic import Field, model_validator

from hal.backend import (
    Backend,
    BuiltRig,
    DeviceProbe,
    ProbeRequest,
    RigKeys,
    RigRequest,
    report_check,
    report_rig_error,
)
from hal.card import (
    COMEDI_DRIVER,
    PCI_DEVICES,
    MSeriesWiring,
    PciCard,
    card_output,
    find_pci_cards,
    judge_holder,
    judge_input_range,
    judge_parts,
)
from hal.comedi.libcomedi import (
    BUSY,
    CALIBRATE,
    FROM_PHYSICAL,
    PERMIT,
    TO_PHYSICAL,
    UNCALIBRATED,
    AnalogChannel,
    ComediFile,
    find_library_path,
    list_ranges,
    load_library,
    read_calibration,
)
from hal.problem import Problem
from hal.rig import RigError


class ComediSettings(MSeriesWiring):
    """Which terminals of which card, in what ranges, and where its calibration lies.

    There is no timeout: the kernel's driver itself gives up on a converter that is silent, and
    a program cannot change how long it waits.
    """

    device: Annotated[
        str, Field(pattern="^/dev/comedi[0-9]+$", description="the card's device file")
    ] = "/dev/comedi0"
    encoder_a_pfi: Annotated[
        int, Field(ge=0, le=15, description="PFI line of the encoder's A; the 37-pin card has 0-7")
    ] = 8
    encoder_b_pfi: Annotated[
        int, Field(ge=0, le=15, description="PFI line of the encoder's B; the 37-pin card has 0-7")
    ] = 10
    calibration_file: Annotated[
        str,
        Field(
            description="made by `comedi_soft_calibrate`; empty: where comedi keeps it; none: "
            "nominal ranges, wrong by some 5 %"
        ),
    ] = ""

    @model_validator(mode="after")
    def _check_lines(self) -> Self:
        if self.encoder_a_pfi == self.encoder_b_pfi:
            raise ValueError("encoder_a_pfi and encoder_b_pfi must be two lines")
        return self


REQUIRED = frozenset(
    {"card.driver", "card.device", "card.channels", "card.calibration", "card.reservations"}
)
"""Findings whose fault means that no rig can be opened; other faults leave it usable."""

_PFI_LINES_OF_37_PINS = 8


def examine_comedi(request: ProbeRequest[ComediSettings]) -> Iterator[Problem]:
    """Check library and driver, then the card and its parts, as far as each step allows."""
    from hal.comedi.comedi_rig import require_card

    settings = request.settings
    yield judge_kernel_driver(find_pci_cards(PCI_DEVICES))
    try:
        load_library()
    except RigError as error:
        yield report_rig_error("card.driver", error, "libcomedi loaded")
        return
    yield report_check("card.driver", "ok", f"libcomedi ({find_library_path()})")
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
        yield report_check("card.device", "ok", found, data=told)
        yield from _examine_parts(file, request, str(told["product_type"]))


def _examine_parts(
    file: ComediFile, request: ProbeRequest[ComediSettings], product: str
) -> Iterator[Problem]:
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


def judge_kernel_driver(cards: Sequence[PciCard]) -> Problem:
    """Say which kernel driver holds NI's cards, and how to get the kernel's own."""
    held = next((card.driver for card in cards if card.driver), "")
    fix = (
        f"NI's driver {held} holds it, so comedi cannot: `pamctl manual wire-the-card` shows how "
        "to switch"
        if held
        else f"sudo modprobe {COMEDI_DRIVER}"
    )
    return judge_holder(cards, COMEDI_DRIVER, lambda driver: driver == COMEDI_DRIVER, fix)


def check_permission(device: Path) -> Iterator[Problem]:
    """Check that this user may use the device file, where there is one."""
    if not device.exists():
        return
    if os.access(device, os.R_OK | os.W_OK):
        yield report_check("card.permission", "ok", f"access to {device}")
        return
    try:
        group = device.group()
    except KeyError:
        group = str(device.stat().st_gid)
    found = f"no access to {device}, of the group {group}"
    fix = PERMIT.format(device=device).replace("GROUP", group)
    yield report_check("card.permission", "fault", found, "read and write", fix)


def judge_pfi_lines(settings: ComediSettings, product: str) -> Problem:
    """Check that the card has terminals for the encoder's lines."""
    lines = (settings.encoder_a_pfi, settings.encoder_b_pfi)
    found = (
        f"{settings.pressure_channel}, {settings.encoder_counter} on PFI {lines[0]} and "
        f"{lines[1]}, {settings.valve_channel}"
    )
    if "37pin" in product and max(lines) >= _PFI_LINES_OF_37_PINS:
        fix = "wire A and B to two of PFI 0 to 7, and set comedi.encoder_a_pfi and encoder_b_pfi"
        return report_check("card.channels", "fault", found, "PFI 0 to 7 on this card", fix)
    return report_check("card.channels", "ok", found)


def judge_calibration(
    file: ComediFile, settings: ComediSettings, sensor: AnalogChannel, valve: AnalogChannel
) -> Problem:
    """Check that the calibration file knows both converters."""
    name, wanted = "card.calibration", "a file from comedi_soft_calibrate"
    if settings.calibration_file == UNCALIBRATED:
        found = "comedi.calibration_file: none: nominal ranges, wrong by some 5 %"
        fix = CALIBRATE.format(device=settings.device).partition(";")[0]
        return report_check(name, "warning", found, wanted, fix)
    try:
        with read_calibration(file, settings.calibration_file) as calibration:
            calibration.get_polynomial(file, sensor, TO_PHYSICAL)
            calibration.get_polynomial(file, valve, FROM_PHYSICAL)
    except RigError as error:
        return report_rig_error(name, error, wanted)
    return report_check(name, "ok", calibration.path)


def judge_locks(file: ComediFile, parts: dict[str, int]) -> Problem:
    """Take each part of the card for a moment; say which of them another program holds."""
    busy: dict[str, RigError] = {}
    for part, subdevice in parts.items():
        try:
            file.lock(subdevice, part)
        except RigError as error:
            busy[part] = error
        else:
            file.unlock(subdevice)
    fix = next(iter(busy.values())).fix if busy else ""
    if all(error.code in BUSY for error in busy.values()):
        fix = f"{fix}; sudo fuser -v {file.path} names it"
    return judge_parts(busy, fix)


def _require(settings: ComediSettings) -> None:
    from hal.comedi.comedi_rig import require_card

    require_card(settings)


def _build(request: RigRequest[ComediSettings]) -> BuiltRig:
    from hal.comedi.comedi_rig import ComediRig

    return BuiltRig(
        ComediRig(request.settings, safe_output_v=request.safe_volts, now_ns=request.now_ns)
    )


COMEDI = Backend(
    name="comedi",
    description="An NI card behind the kernel's own driver. `safe_volts` has no default: only "
    "its owner knows what is safe.",
    settings=ComediSettings,
    rig_file="pci6221-comedi",
    safe_volts=None,
    device=lambda settings: PurePosixPath(settings.device).name,
    output=card_output,
    build=_build,
    require=_require,
    keys=RigKeys(
        pressure_input="comedi.pressure_channel",
        pressure_wiring="comedi.terminal",
        encoder_input="comedi.encoder_a_pfi",
        encoder_filter="comedi.encoder_filter_ns",
        valve_output="comedi.valve_channel",
    ),
    probe=DeviceProbe(examine_comedi, REQUIRED),
)
