"""What is there of an NI card, found out without moving anything: for `pamctl doctor`.

Tasks are reserved and let go again, an input is read; the one function that writes to the output
says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from nidaqmx.constants import TaskMode, TerminalConfiguration
from nidaqmx.stream_readers import AnalogSingleChannelReader
from nidaqmx.system import Device, System

from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.hardware_timed import HardwareTimedRig
from hal.nidaq.on_demand import _find_loaded_library, _make_task, raise_rig_errors, require_card
from hal.rig import RigError, open_rig

_HARDWARE_TIMED_SAMPLES = 20

Range = tuple[float, float]


class Driver(NamedTuple):
    """The driver, and the devices that it knows."""

    package: str
    """Version of the Python package nidaqmx."""
    version: str
    library: str
    devices: tuple[str, ...]


class Card(NamedTuple):
    """What one card says of itself. Ranges in V."""

    product_type: str
    serial_number: int
    bus: str
    is_simulated: bool
    """By NI's own driver: its counters never count."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    counters: tuple[str, ...]
    input_ranges: tuple[Range, ...]
    output_ranges: tuple[Range, ...]


class DriverUser(NamedTuple):
    """A process that has the driver loaded."""

    pid: int
    command: str


def identify_driver() -> Driver:
    """Load the driver; raise `RigError` where there is none."""
    with raise_rig_errors("asking the driver for its version and devices"):
        system = System.local()
        numbers = system.driver_version
        names = tuple(device.name for device in system.devices)
    return Driver(version("nidaqmx"), ".".join(map(str, numbers)), _find_loaded_library(), names)


def identify_card(name: str) -> Card:
    """Ask a card who it is; raise `RigError` where it does not answer."""
    with raise_rig_errors(f"looking for {name}"):
        device = Device(name)
        return Card(
            product_type=str(device.product_type),
            serial_number=int(device.serial_num),
            bus=str(device.bus_type.name),
            is_simulated=bool(device.is_simulated),
            inputs=_strip_device_names(device.ai_physical_chans),
            outputs=_strip_device_names(device.ao_physical_chans),
            counters=_strip_device_names(device.ci_physical_chans),
            input_ranges=_pair_ranges(device.ai_voltage_rngs),
            output_ranges=_pair_ranges(device.ao_voltage_rngs),
        )


def find_conflicts(settings: NidaqSettings) -> dict[str, RigError]:
    """Try to reserve input, counter and output; return what each that fails says, by its name."""
    found = {}
    for channel in (settings.pressure_channel, settings.encoder_counter, settings.valve_channel):
        try:
            _reserve(settings, channel)
        except RigError as error:
            found[channel] = error
    return found


def find_driver_users(ignore: Sequence[int]) -> list[DriverUser]:
    """Find other processes with the driver loaded, as far as this user may look."""
    users = []
    for process in Path("/proc").glob("[0-9]*"):
        pid = int(process.name)
        if pid in ignore:
            continue
        try:
            if "/libnidaqmx.so" not in (process / "maps").read_text():
                continue
            command = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
        except (OSError, UnicodeDecodeError):
            continue
        users.append(DriverUser(pid, command))
    return sorted(users)


def try_on_demand_read(settings: NidaqSettings) -> RigError | None:
    """Read the input once when asked; return why that does not work."""
    return _catch_rig_error(lambda: _read_on_demand(settings))


def try_hardware_timing(
    settings: NidaqSettings, rate_hz: float, safe_output_v: float
) -> RigError | None:
    """Let the card pace a few ticks, the safe voltage on its output; return why that fails.

    Unlike all else here it writes: what every start of a run writes first.
    """
    timed = settings.model_copy(update={"timing": "hardware_timed"})

    def tick() -> None:
        require_card(timed)
        rig = HardwareTimedRig(timed, rate_hz=rate_hz, safe_output_v=safe_output_v)
        with open_rig(rig):
            for _ in range(_HARDWARE_TIMED_SAMPLES):
                rig.await_edge()
                rig.read()
                rig.write(safe_output_v)

    return _catch_rig_error(tick)


def _read_on_demand(settings: NidaqSettings) -> None:
    with raise_rig_errors("reading when asked"), _make_task("probe") as task:
        _add_input(task, settings)
        task.start()
        AnalogSingleChannelReader(task.in_stream).read_one_sample(settings.timeout_s)


def _catch_rig_error(reading: Callable[[], None]) -> RigError | None:
    try:
        reading()
    except RigError as error:
        return error
    return None


def _reserve(settings: NidaqSettings, channel: str) -> None:
    with raise_rig_errors(f"reserving {settings.device}/{channel}"), _make_task("probe") as task:
        physical = f"{settings.device}/{channel}"
        if channel == settings.pressure_channel:
            _add_input(task, settings)
        elif channel == settings.encoder_counter:
            task.ci_channels.add_ci_lin_encoder_chan(physical)
        else:
            task.ao_channels.add_ao_voltage_chan(
                physical, min_val=settings.output_low_v, max_val=settings.output_high_v
            )
        # An output keeps its voltage: a task that is reserved has written nothing.
        task.control(TaskMode.TASK_RESERVE)


def _add_input(task, settings: NidaqSettings) -> None:  # type: ignore[no-untyped-def]
    task.ai_channels.add_ai_voltage_chan(
        f"{settings.device}/{settings.pressure_channel}",
        terminal_config=TerminalConfiguration[settings.terminal.upper()],
        min_val=settings.input_low_v,
        max_val=settings.input_high_v,
    )


def _strip_device_names(collection) -> tuple[str, ...]:  # type: ignore[no-untyped-def]
    """Return the names behind the device's: `ai0` of `Dev1/ai0`."""
    return tuple(name.partition("/")[2] for name in collection.channel_names)


def _pair_ranges(flat: Sequence[float]) -> tuple[Range, ...]:
    return tuple(zip(flat[::2], flat[1::2], strict=True))
