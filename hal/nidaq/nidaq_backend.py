"""The record of the NI card, and its checks for the doctor: driver, parts, conflicts, timing.

What the kernel says is read from the file system, before NI's driver is loaded: where the
kernel's side is wrong, NI's own tools see no card and do not say why. nidaqmx is imported only
where the card is really needed: a PC without a card need not have it.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hal.backend import (
    Backend,
    BuiltRig,
    DeviceProbe,
    ProbeRequest,
    RigKeys,
    RigRequest,
    describe_rig_error,
    report_check,
    report_rig_error,
)
from hal.card import (
    COMEDI_DRIVER,
    PCI_DEVICES,
    card_output,
    find_pci_cards,
    format_range,
    holds,
    judge_holder,
    judge_input_range,
    judge_parts,
    read_line,
)
from hal.nidaq.card_settings import BUSY_CODES, ON_DEMAND, PACKAGE_BROKEN, NidaqSettings
from hal.problem import Problem
from hal.rig import RigError

if TYPE_CHECKING:
    from hal.nidaq.probe import Card, ClockTrial


REQUIRED = frozenset({"card.driver", "card.device", "card.channels", "card.reservations"})
"""Findings whose fault means that no rig can be opened; other faults leave it usable."""


_LOOPBACK_V = 0.05
_RELEASE_S = 0.05
_MISSED_OFTEN = 0.25
"""A clock that misses every second edge misses half of them."""
_GOOD_WAIT = "WAIT_FOR_INTERRUPT"


def examine_card(request: ProbeRequest[NidaqSettings]) -> Iterator[Problem]:
    """Check the driver, then the card, then its parts, as far as each step allows the next."""
    settings = request.settings
    nodes = check_device_nodes(Path("/dev"))
    yield from examine_kernel(is_clocked=settings.timing == "hardware_timed")
    try:
        from hal.nidaq import probe
        from hal.nidaq.driver import require_card
    # Any exception at all: the package reads every `.env` file from this directory upwards.
    except Exception as error:
        found = f"the package nidaqmx cannot be imported: {error}"
        yield report_check("card.driver", "fault", found, "nidaqmx imported", PACKAGE_BROKEN)
        return
    try:
        driver = probe.identify_driver()
    except RigError as error:
        yield report_rig_error("card.driver", error, "NI-DAQmx for Linux loaded")
        yield from nodes
        return
    found = f"NI-DAQmx {driver.version} ({driver.library}), package nidaqmx {driver.package}"
    yield report_check("card.driver", "ok", found, data=driver._asdict())
    yield from nodes
    try:
        card = probe.identify_card(settings.device)
        require_card(settings)
    except RigError as error:
        there = f"the driver lists {', '.join(driver.devices) or 'no device'}"
        wanted = f"{settings.device}, as nidaq.device of the rig file says"
        yield report_check(
            "card.device", "fault", f"{describe_rig_error(error)}; {there}", wanted, error.fix
        )
        return
    yield judge_device(settings.device, card)
    yield judge_channels(settings, card)
    asked = (settings.input_low_v, settings.input_high_v)
    yield judge_input_range("nidaq", asked, card.input_ranges, request)
    yield judge_output_range(settings, card)
    busy = probe.find_conflicts(settings)
    yield judge_reservations(busy)
    if settings.pressure_channel in busy:
        return
    failure = probe.try_on_demand_read(settings)
    yield (
        report_rig_error("timing.on_demand", failure, "a read on demand")
        if failure
        else report_check("timing.on_demand", "ok", "works")
    )


def examine_card_clock(request: ProbeRequest[NidaqSettings]) -> Problem:
    """Try the card's own clock with the safe voltage on the output; the caller holds the device."""
    from hal.nidaq.probe import try_hardware_timing

    settings = request.settings
    is_wanted = settings.timing == "hardware_timed"
    try:
        trial = try_hardware_timing(settings, request.rate_hz, request.safe_volts)
    except RigError as error:
        return report_no_hardware_timing(error, is_wanted)
    return judge_hardware_timing(trial, 1.0 / request.rate_hz, is_wanted)


def examine_output(request: ProbeRequest[NidaqSettings]) -> Iterator[Problem]:
    """Check what becomes of the output when its process is killed; the caller holds the device."""
    from hal.nidaq.probe import measure_release

    try:
        yield judge_release(measure_release(request.settings))
    except RigError as error:
        found = f"not measured: {describe_rig_error(error)}"
        yield report_check("card.release", "warning", found, "", error.fix)


def judge_release(free_after_s: float | None) -> Problem:
    """Say whether the driver frees what a killed process held: the guardian relies on it."""
    name, data = "card.release", {"free_after_s": free_after_s}
    if free_after_s is None:
        found = "the driver keeps the reservation of a killed process"
        fix = (
            "do not run: no guardian could vent the muscle after a crash. Reset the device "
            "(`nidaqmx` Device.reset_device, which puts 0 V out), update NI-DAQmx, or use "
            "--backend comedi, where the kernel frees the card"
        )
        return report_check(name, "fault", found, "the output is free at once", fix, data)
    found = f"the output of a killed process was free after {free_after_s * 1e3:.0f} ms"
    if free_after_s <= _RELEASE_S:
        return report_check(name, "ok", found, data=data)
    wanted = f"at most {_RELEASE_S * 1e3:.0f} ms"
    fix = "after a crash of the loop the muscle stays filled for so long: fit a hardware vent"
    return report_check(name, "warning", found, wanted, fix, data)


def check_device_nodes(directory: Path) -> Iterator[Problem]:
    """Check that this user may use the driver's device nodes, where there are any."""
    nodes = sorted([*directory.glob("nidaq*"), *directory.glob("nipal*")])
    barred = [node for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    if barred:
        yield report_check(
            "card.permission",
            "fault",
            f"no access to {', '.join(map(str, barred))}",
            "read and write",
            f"ls -l {barred[0]} shows its group: sudo usermod -aG GROUP $USER, and log in again",
        )
    elif nodes:
        yield report_check("card.permission", "ok", f"access to {', '.join(map(str, nodes))}")


def judge_device(name: str, card: Card) -> Problem:
    """Say which card it is."""
    found = f"{name}: {card.product_type}, serial {card.serial_number:X}, bus {card.bus}"
    data = card._asdict()
    if card.is_simulated:
        fix = "a device simulated by NI's driver: its encoder never counts; use --backend sim"
        return report_check("card.device", "fault", found, "a card", fix, data)
    return report_check("card.device", "ok", found, data=data)


def judge_channels(settings: NidaqSettings, card: Card) -> Problem:
    """Check that the card has the terminals that the rig file names."""
    asked = {
        "pressure_channel": (settings.pressure_channel, card.inputs),
        "encoder_counter": (settings.encoder_counter, card.counters),
        "valve_channel": (settings.valve_channel, card.outputs),
    }
    for key, line in (
        ("encoder_a_pfi", settings.encoder_a_pfi),
        ("encoder_b_pfi", settings.encoder_b_pfi),
    ):
        if line is not None:
            lines = tuple(name for name in card.terminals if name.startswith("PFI"))
            asked[key] = (f"PFI{line}", lines)
    found = ", ".join(f"{channel}" for channel, _ in asked.values())
    missing = {key: there for key, (channel, there) in asked.items() if channel not in there}
    if not missing:
        return report_check("card.channels", "ok", found)
    there = "; ".join(f"nidaq.{key}: {', '.join(names)}" for key, names in missing.items())
    fix = f"correct {' and '.join(f'nidaq.{key}' for key in missing)} in the rig file"
    return report_check("card.channels", "fault", found, f"one of {there}", fix)


def judge_output_range(settings: NidaqSettings, card: Card) -> Problem:
    """Check that the card can put out what the rig file allows."""
    asked = (settings.output_low_v, settings.output_high_v)
    found = (
        f"{format_range(asked)} of the card's {', '.join(map(format_range, card.output_ranges))}"
    )
    if any(holds(one, asked) for one in card.output_ranges):
        return report_check("card.output_range", "ok", found)
    fix = "correct nidaq.output_low_v and nidaq.output_high_v"
    return report_check("card.output_range", "fault", found, "within the card's range", fix)


def judge_reservations(busy: dict[str, RigError]) -> Problem:
    """Say which parts of the card another program holds."""
    fix = next(iter(busy.values())).fix if busy else ""
    if all(error.code in BUSY_CODES for error in busy.values()):
        fix = f"{fix}; as root, `grep -l libnidaqmx /proc/[0-9]*/maps` names it"
    return judge_parts(busy, fix)


def judge_hardware_timing(trial: ClockTrial, period_s: float, is_wanted: bool) -> Problem:
    """Say whether the card's own clock can pace the loop."""
    name, data = "timing.hardware", trial._asdict()
    found = f"{trial.edges} edges, {trial.missed} missed"
    if trial.missed > _MISSED_OFTEN * trial.edges:
        # The PC misses an edge now and then. A clock that is wrong misses them regularly.
        wanted = f"a sample every {period_s * 1e3:g} ms"
        fix = f"is rig.loop.rate_hz too fast for card or PC? {ON_DEMAND}"
        return report_check(name, "fault" if is_wanted else "ok", found, wanted, fix, data)
    if trial.wait_mode != _GOOD_WAIT:
        return report_check(
            name,
            "warning" if is_wanted else "ok",
            f"{found}; a read waits by {trial.wait_mode or 'a mode that the driver hides'}",
            f"{_GOOD_WAIT}: a read that polls is stopped by the kernel at real-time priority",
            f"{ON_DEMAND}, or run with --rt off",
            data,
        )
    if trial.missed:
        fix = "is the PC busy? See pc.wakeup"
        return report_check(name, "warning" if is_wanted else "ok", found, "none missed", fix, data)
    return report_check(name, "ok", f"works: {found}", data=data)


def report_no_hardware_timing(failure: RigError, is_wanted: bool) -> Problem:
    """Say why the card's own clock cannot pace the loop."""
    name = "timing.hardware"
    if is_wanted:
        return report_rig_error(name, failure, "as nidaq.timing says")
    found = f"not available, and not needed: {describe_rig_error(failure)}"
    return report_check(name, "ok", found)


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
) -> Iterator[Problem]:
    """Check who holds the card, whether NI's modules are built, and the IOMMU."""
    cards, release = find_pci_cards(pci), platform.release()
    fix = (
        "the kernel's own driver took it, so NI's tools see nothing: write `blacklist ni_pcimio` "
        "to /etc/modprobe.d/ni_pcimio.conf and restart the PC; or use --backend comedi"
        if any(card.driver == COMEDI_DRIVER for card in cards)
        else "NI's modules are not loaded: see card.modules, and `sudo dmesg`, which names modules "
        "that secure boot refused"
    )
    yield judge_holder(cards, "NI's driver", lambda one: one not in ("", COMEDI_DRIVER), fix)
    sources = sorted(dkms.glob("ni*")) if dkms.is_dir() else []
    modules = [Module(one.name, any(one.glob(f"*/{release}/*/module"))) for one in sources]
    if modules:
        yield judge_modules(modules, release)
    if cards:
        # Such as identity or DMA-FQ; empty without one.
        types = {one.slot: read_line(pci / one.slot / "iommu_group" / "type") for one in cards}
        yield judge_iommu(types, is_clocked)


def judge_modules(modules: Sequence[Module], release: str) -> Problem:
    """Check that DKMS has built NI's modules for the running kernel."""
    name, data = "card.modules", {"modules": [module._asdict() for module in modules]}
    missing = [module.name for module in modules if not module.is_built]
    if not missing:
        found = f"NI's modules built for kernel {release}: {len(modules)}"
        return report_check(name, "ok", found, data=data)
    return report_check(
        name,
        "fault",
        f"not built for kernel {release}: {', '.join(missing)}",
        "all modules of NI's that DKMS knows",
        f"sudo apt install linux-headers-{release}; sudo dkms autoinstall; restart the PC. Where "
        "that fails, start a kernel that NI supports: `dkms status` lists those built for",
        data,
    )


def judge_iommu(types: dict[str, str], is_clocked: bool) -> Problem:
    """Say whether the IOMMU stands between card and memory: clocked tasks failed on such PCs."""
    name, data = "card.iommu", {"types": types}
    translated = [slot for slot, kind in types.items() if kind.startswith(_TRANSLATED)]
    if not translated:
        return report_check(name, "ok", "not between card and memory", data=data)
    found = f"translates the addresses of {', '.join(translated)}"
    wanted = "no IOMMU between card and memory, for nidaq.timing: hardware_timed"
    if is_clocked:
        return report_check(name, "warning", found, wanted, _IOMMU_FIX, data)
    return report_check(name, "ok", f"{found}; on demand needs no transfers", data=data)


def _require(settings: NidaqSettings) -> None:
    try:
        from hal.nidaq.driver import require_card
    # Any exception at all: the package reads every `.env` file from this directory upwards.
    except Exception as error:
        raise RigError(
            f"the package nidaqmx cannot be imported: {error}", fix=PACKAGE_BROKEN
        ) from error
    require_card(settings)


def _build(request: RigRequest[NidaqSettings]) -> BuiltRig:
    settings = request.settings
    if request.by_computer or settings.timing == "on_demand":
        from hal.nidaq.nidaq_rig import NidaqRig

        return BuiltRig(NidaqRig(settings, safe_output_v=request.safe_volts, now_ns=request.now_ns))

    from hal.nidaq.nidaq_rig import HardwareTimedRig

    timed = HardwareTimedRig(
        settings,
        rate_hz=request.rate_hz,
        safe_output_v=request.safe_volts,
        now_ns=request.now_ns,
    )
    return BuiltRig(timed, timed.await_edge)


def _check(settings: NidaqSettings, rate_hz: float) -> None:
    if settings.timing == "hardware_timed" and settings.timeout_s * rate_hz < 2:
        raise ValueError(
            f"nidaq.timeout_s {settings.timeout_s:g} is less than two periods of "
            f"loop.rate_hz {rate_hz:g}: a hardware-timed read waits for one"
        )


NIDAQ = Backend(
    name="nidaq",
    description="An NI card. `safe_volts` has no default: only its owner knows what is safe.",
    settings=NidaqSettings,
    rig_file="pci6221",
    safe_volts=None,
    device=lambda settings: settings.device,
    output=card_output,
    build=_build,
    require=_require,
    check=_check,
    keys=RigKeys(
        pressure_input="nidaq.pressure_channel",
        pressure_wiring="nidaq.terminal",
        encoder_input="nidaq.encoder_counter",
        encoder_filter="nidaq.encoder_filter_ns",
        valve_output="nidaq.valve_channel",
    ),
    probe=DeviceProbe(examine_card, REQUIRED, examine_card_clock, examine_output),
)
