"""What the driver says of an NI card, found out without moving anything.

Tasks are reserved and released, an input is read. Only `try_hardware_timing` writes to the output.
As a process of its own (`child_command`) it reserves the valve's output until it is killed: the
doctor kills it, to measure how long the driver keeps a dead process's reservation.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from importlib.metadata import version
from typing import NamedTuple

from nidaqmx import Task
from nidaqmx.constants import TaskMode
from nidaqmx.system import Device, System

from hal.card import find_loaded_library
from hal.child import child_command
from hal.nidaq.card_settings import BUSY_CODES, NidaqSettings
from hal.nidaq.driver import (
    LIBRARY,
    make_encoder_task,
    make_pressure_task,
    make_valve_task,
    make_volt_reader,
    raise_rig_errors,
    require_card,
)
from hal.nidaq.nidaq_rig import HardwareTimedRig
from hal.rig import RigError, open_rig

RELEASE_PATIENCE_S = 1.0
"""Ten times what a guardian needs from a frozen loop to the safe voltage."""
_HARDWARE_TIMED_SAMPLES = 100

HELD = "held"
"""What it prints once it holds the output."""

Range = tuple[float, float]
TaskMaker = Callable[[NidaqSettings], AbstractContextManager[Task]]


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
    """True: simulated by NI's own driver, whose counters never count."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    counters: tuple[str, ...]
    terminals: tuple[str, ...]
    """Such as PFI0: where a signal can come in."""
    input_ranges: tuple[Range, ...]
    output_ranges: tuple[Range, ...]


class ClockTrial(NamedTuple):
    """How the card's own clock paced some ticks."""

    edges: int
    missed: int
    """Of these, the ones whose sample was never read."""
    wait_mode: str
    """How a read waits for the edge, as the driver says."""
    data_transfer: object
    """What moves the data of input, counter and output, as the driver says."""


def identify_driver() -> Driver:
    """Load the driver; raise `RigError` where there is none."""
    with raise_rig_errors("asking the driver for its version and devices"):
        system = System.local()
        numbers = system.driver_version
        names = tuple(device.name for device in system.devices)
    library = find_loaded_library(LIBRARY)
    return Driver(version("nidaqmx"), ".".join(map(str, numbers)), library, names)


def identify_card(name: str) -> Card:
    """Ask a card for its type and parts; raise `RigError` where it does not answer."""
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
            terminals=tuple(name.rpartition("/")[2] for name in device.terminals),
            input_ranges=_pair_ranges(device.ai_voltage_rngs),
            output_ranges=_pair_ranges(device.ao_voltage_rngs),
        )


def find_conflicts(settings: NidaqSettings) -> dict[str, RigError]:
    """Try to reserve input, counter and output; return the errors by the name of the part."""
    parts: dict[str, TaskMaker] = {
        settings.pressure_channel: make_pressure_task,
        settings.encoder_counter: make_encoder_task,
        settings.valve_channel: make_valve_task,
    }
    found = {}
    for channel, make_task in parts.items():
        try:
            _reserve(settings, channel, make_task)
        except RigError as error:
            found[channel] = error
    return found


def measure_release(settings: NidaqSettings) -> float | None:
    """Kill a process that holds the output; return after how long (s) the output was free.

    None: it was not free within `RELEASE_PATIENCE_S`. Raises `RigError` where no process could
    hold it.
    """
    holder = child_command(__name__, settings.model_dump_json())
    with subprocess.Popen(
        holder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        told = process.stdout.readline().strip()
        killed_s = time.monotonic()
        process.kill()
    if told != HELD:
        raise RigError("no second process could hold the output", fix="is the PC short of memory?")
    while True:
        waited_s = time.monotonic() - killed_s
        try:
            _reserve(settings, settings.valve_channel, make_valve_task)
        except RigError as error:
            if error.code not in BUSY_CODES:
                raise
            if waited_s > RELEASE_PATIENCE_S:
                return None
            time.sleep(1e-3)
        else:
            return waited_s


def try_on_demand_read(settings: NidaqSettings) -> RigError | None:
    """Read the input once on demand; return the error where it fails."""
    try:
        with raise_rig_errors("reading on demand"), make_pressure_task(settings) as task:
            task.start()
            make_volt_reader(task)(settings.timeout_s)
    except RigError as error:
        return error
    return None


def try_hardware_timing(
    settings: NidaqSettings,
    rate_hz: float,
    safe_output_v: float,
    now_ns: Callable[[], int] = time.monotonic_ns,
) -> ClockTrial:
    """Let the card pace some ticks with the safe voltage on its output. Raises `RigError`.

    It writes to the output, but only what every start of a run writes first.
    """
    timed = settings.model_copy(update={"timing": "hardware_timed"})
    require_card(timed)
    rig = HardwareTimedRig(timed, rate_hz=rate_hz, safe_output_v=safe_output_v, now_ns=now_ns)
    missed = 0
    with open_rig(rig):
        for sample in range(_HARDWARE_TIMED_SAMPLES):
            edge = rig.await_edge()
            # The first edges pass while the tasks start.
            missed += edge.elapsed - 1 if sample else 0
            rig.read()
            rig.write(safe_output_v)
        told = rig.describe().extra
    edges = _HARDWARE_TIMED_SAMPLES + missed
    return ClockTrial(edges, missed, str(told["wait_mode"]), told["data_transfer_in_use"])


def _reserve(settings: NidaqSettings, channel: str, make_task: TaskMaker) -> None:
    with raise_rig_errors(f"reserving {settings.device}/{channel}"), make_task(settings) as task:
        # A task that is only reserved writes nothing: the output keeps its voltage.
        task.control(TaskMode.TASK_RESERVE)


def _strip_device_names(collection) -> tuple[str, ...]:  # type: ignore[no-untyped-def]
    """Return the names behind the device's: `ai0` of `Dev1/ai0`."""
    return tuple(name.partition("/")[2] for name in collection.channel_names)


def _pair_ranges(flat: Sequence[float]) -> tuple[Range, ...]:
    return tuple(zip(flat[::2], flat[1::2], strict=True))


def hold_output() -> None:
    """Hold the output that the settings on the command line name, until standard input ends."""
    with make_valve_task(NidaqSettings.model_validate_json(sys.argv[1])) as task:
        task.control(TaskMode.TASK_RESERVE)
        print(HELD, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    hold_output()
