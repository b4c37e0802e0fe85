"""Is the card what the rig file says: driver, channels, ranges, conflicts, timing."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from hal.nidaq.card_settings import NidaqSettings
from hal.rig import RigError
from pamctl.commissioning.doctor.findings import Finding, told
from pamctl.settings.rig_file import NidaqRigSettings

if TYPE_CHECKING:  # importing it loads nidaqmx, which a PC without a card need not do
    from hal.nidaq.probe import Card, Range, User

_BUSY = (-50103, -200022)


def card_findings(rig: NidaqRigSettings) -> Iterator[Finding]:
    """Look at driver and card, from the outside inwards, as far as each step allows the next."""
    nodes = device_nodes(Path("/dev"))
    try:
        from hal.nidaq import probe
        from hal.nidaq.on_demand import require_card
    # Whatever it is: the package reads any `.env` that it finds from here upwards.
    except Exception as error:
        fix = "move a broken .env or settings.ini out of this directory, or reinstall pamctl"
        found = f"the package nidaqmx cannot be imported: {error}"
        yield Finding("card.driver", "fault", found, "nidaqmx imported", fix)
        return
    try:
        driver = probe.driver()
    except RigError as error:
        yield Finding("card.driver", "fault", told(error), "NI-DAQmx for Linux loaded", error.fix)
        yield from nodes
        return
    found = f"NI-DAQmx {driver.version} ({driver.library}), package nidaqmx {driver.package}"
    yield Finding("card.driver", "ok", found, data=driver._asdict())
    yield from nodes
    settings = rig.nidaq
    try:
        card = probe.card(settings.device)
        require_card(settings)
    except RigError as error:
        there = f"the driver lists {', '.join(driver.devices) or 'no device'}"
        wanted = f"{settings.device}, as nidaq.device of the rig file says"
        yield Finding("card.device", "fault", f"{told(error)}; {there}", wanted, error.fix)
        return
    yield device(settings.device, card)
    yield channels(settings, card)
    yield input_range(rig, card)
    yield output_range(settings, card)
    busy = probe.conflicts(settings)
    yield reservations(busy, probe.driver_users([os.getpid()]) if busy else [])
    if settings.pressure_channel in busy:
        return
    yield on_demand(probe.on_demand_failure(settings))


def clock_finding(rig: NidaqRigSettings) -> Finding:
    """Try the card's own clock, with the safe voltage on the output; hold the device for it."""
    from hal.nidaq.probe import hardware_timed_failure

    failure = hardware_timed_failure(rig.nidaq, rig.loop.rate_hz, rig.safe_volts)
    return hardware_timed(failure, rig.nidaq.timing == "hardware_timed")


def device_nodes(directory: Path) -> Iterator[Finding]:
    """See that this user may talk to the driver's kernel part, where its nodes can be seen."""
    nodes = sorted([*directory.glob("nidaq*"), *directory.glob("nipal*")])
    barred = [node for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    if barred:
        yield Finding(
            "card.permission",
            "fault",
            f"no access to {', '.join(map(str, barred))}",
            "read and write",
            f"ls -l {barred[0]} shows its group: sudo usermod -aG GROUP $USER, and log in again",
        )
    elif nodes:
        yield Finding("card.permission", "ok", f"access to {', '.join(map(str, nodes))}")


def device(name: str, card: Card) -> Finding:
    """Say which card it is."""
    found = f"{name}: {card.product_type}, serial {card.serial_number:X}, bus {card.bus}"
    data = card._asdict()
    if card.is_simulated:
        fix = "a device simulated by NI's driver: its encoder never counts; use --backend sim"
        return Finding("card.device", "fault", found, "a card", fix, data)
    return Finding("card.device", "ok", found, data=data)


def channels(settings: NidaqSettings, card: Card) -> Finding:
    """See that the card has the terminals that the rig file names."""
    asked = {
        "pressure_channel": (settings.pressure_channel, card.inputs),
        "encoder_counter": (settings.encoder_counter, card.counters),
        "valve_channel": (settings.valve_channel, card.outputs),
    }
    found = ", ".join(f"{channel}" for channel, _ in asked.values())
    missing = {key: there for key, (channel, there) in asked.items() if channel not in there}
    if not missing:
        return Finding("card.channels", "ok", found)
    there = "; ".join(f"nidaq.{key}: {', '.join(names)}" for key, names in missing.items())
    fix = f"correct {' and '.join(f'nidaq.{key}' for key in missing)} in the rig file"
    return Finding("card.channels", "fault", found, f"one of {there}", fix)


def input_range(rig: NidaqRigSettings, card: Card) -> Finding:
    """See that the input's range holds every voltage that a limit has to see."""
    name, settings, limits, cal = "card.input_range", rig.nidaq, rig.limits, rig.calibration
    asked = (settings.input_low_v, settings.input_high_v)
    taken = _narrowest(asked, card.input_ranges)
    highest_v = (
        cal.sensor_zero_v + (limits.pressure_pa - cal.atmospheric_pressure_pa) / cal.sensor_pa_per_v
    )
    least = (limits.sensor_low_v, max(limits.sensor_high_v, highest_v))
    found = f"asked {_shown(asked)}" + (f", the card takes {_shown(taken)}" if taken else "")
    if taken is None:
        wanted = f"within one of {', '.join(map(_shown, card.input_ranges))}"
        fix = "correct nidaq.input_low_v and nidaq.input_high_v"
        return Finding(name, "fault", found, wanted, fix)
    resolution_pa = (taken[1] - taken[0]) / 65536 * cal.sensor_pa_per_v
    data = {"low_v": taken[0], "high_v": taken[1], "step_pa": resolution_pa}
    if not _holds(asked, least) or not _holds(taken, least):
        wanted = f"at least {_shown(least)}, or limits.pressure_pa and the wire are not watched"
        fix = f"set nidaq.input_low_v to {-5.0:g} and nidaq.input_high_v to {5.0:g}"
        return Finding(name, "fault", found, wanted, fix, data)
    return Finding(name, "ok", f"{found}: {resolution_pa:.0f} Pa a code", data=data)


def output_range(settings: NidaqSettings, card: Card) -> Finding:
    """See that the card can put out what the rig file allows."""
    asked = (settings.output_low_v, settings.output_high_v)
    found = f"{_shown(asked)} of the card's {', '.join(map(_shown, card.output_ranges))}"
    if any(_holds(one, asked) for one in card.output_ranges):
        return Finding("card.output_range", "ok", found)
    fix = "correct nidaq.output_low_v and nidaq.output_high_v"
    return Finding("card.output_range", "fault", found, "within the card's range", fix)


def reservations(busy: dict[str, RigError], users: list[User]) -> Finding:
    """Say which parts of the card another program holds, and who may be holding them."""
    if not busy:
        return Finding("card.reservations", "ok", "input, counter and output are free")
    error = next(iter(busy.values()))
    found = "; ".join(told(error) for error in busy.values())
    if any(error.code not in _BUSY for error in busy.values()):
        return Finding("card.reservations", "fault", found, "free", error.fix)
    who = "; ".join(f"process {user.pid} ({user.command})" for user in users)
    fix = f"end what uses the driver: {who}" if who else f"{error.fix}; as root, this names it"
    data = {"channels": sorted(busy), "users": [user._asdict() for user in users]}
    return Finding("card.reservations", "fault", found, "free", fix, data)


def on_demand(failure: RigError | None) -> Finding:
    """Tell whether a read works when it is asked for."""
    if failure is None:
        return Finding("timing.on_demand", "ok", "works")
    return Finding("timing.on_demand", "fault", told(failure), "a read when asked", failure.fix)


def hardware_timed(failure: RigError | None, is_wanted: bool) -> Finding:
    """Tell whether the card's own clock can pace the loop."""
    name = "timing.hardware"
    if failure is None:
        return Finding(name, "ok", "works: the card's clock can pace the loop")
    if is_wanted:
        fix = f"set nidaq.timing to on_demand; {failure.fix}"
        return Finding(name, "fault", told(failure), "as nidaq.timing says", fix)
    return Finding(name, "ok", f"not available, and not needed: {told(failure)}")


def _narrowest(asked: Range, ranges: tuple[Range, ...]) -> Range | None:
    fitting = [one for one in ranges if _holds(one, asked)]
    return min(fitting, key=lambda one: one[1] - one[0], default=None)


def _holds(outer: Range, inner: Range) -> bool:
    return outer[0] <= inner[0] and inner[1] <= outer[1]


def _shown(pair: Range) -> str:
    return f"{pair[0]:g} to {pair[1]:g} V"
