"""NI-DAQmx itself: driver and card, their errors as `RigError`, the tasks and the fast calls.

Only the stream readers and writers over a running task are fast. `Task.read` and `Task.write` cost
ten times as much. A task that does not run is started and stopped by every call, which sets the
encoder back to zero each time.
"""

from __future__ import annotations

import ctypes
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from typing import Any, NamedTuple

from nidaqmx import Task
from nidaqmx.constants import (
    BusType,
    ChannelType,
    DataTransferActiveTransferMode,
    EncoderType,
    LengthUnits,
    TerminalConfiguration,
    WaitMode,
)
from nidaqmx.errors import DaqError, DaqNotFoundError, DaqNotSupportedError, DaqWarning
from nidaqmx.errors import Error as DriverError
from nidaqmx.stream_readers import AnalogSingleChannelReader, CounterReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter
from nidaqmx.system import Device, System

from hal.card import find_loaded_library, refuse_stand_in
from hal.nidaq.card_settings import INSTALL, NOT_OFFERED, ON_DEMAND, NidaqSettings, fix_of
from hal.rig import RigError

STAND_IN_SERIAL = 0xDECAF
"""Serial number of the driver that stands in for a card in this project's tests."""
LIBRARY = "libnidaqmx.so"
"""The driver's C library, which the package loads."""

_TIMED_BUSES = (BusType.PCI, BusType.PCIE, BusType.PXI, BusType.PXIE)

_LEFT_OUT = ("Status Code:", "Task Name:")

NO_DRIVER = (DaqNotFoundError, DaqNotSupportedError)
"""Errors of a computer without NI-DAQmx."""
FAILURES = (DriverError, ctypes.ArgumentError, OSError, ValueError)
"""Errors of a call. ArgumentError: ctypes refuses an argument. OSError: the library cannot be
loaded. ValueError: a count is not a number."""


def require_card(settings: NidaqSettings) -> Mapping[str, object]:
    """Load the driver and find the card; return their versions and names for `describe`.

    Raises `RigError` where one is missing, or where the card is the tests' stand-in.
    """
    with raise_rig_errors(f"looking for {settings.device}"):
        version = System.local().driver_version
        device = Device(settings.device)
        serial = int(device.serial_num)
        bus = device.bus_type
        identity = {
            "library": find_loaded_library(LIBRARY),
            "driver_version": ".".join(map(str, version)),
            "product_type": str(device.product_type),
            "serial_number": f"{serial:X}",
        }
    if settings.timing == "hardware_timed" and bus not in _TIMED_BUSES:
        raise RigError(
            f"{settings.device} is a {identity['product_type']} on {bus.name}: "
            "no hardware-timed single points there",
            fix=ON_DEMAND,
        )
    if serial == STAND_IN_SERIAL:
        refuse_stand_in(settings.device, identity["library"])
    return identity


def make_rig_error(doing: str, error: Exception) -> RigError:
    """Return the driver's message with its error number and its fix."""
    if isinstance(error, NO_DRIVER):
        return RigError("no NI-DAQmx driver on this computer", fix=INSTALL)
    said = join_lines(str(error))
    if isinstance(error, DaqError):
        code = error.error_code
        return RigError(f"{doing}: {said}", fix=fix_of(code), code=code)
    return RigError(f"{doing}: {said or type(error).__name__}", fix="is NI-DAQmx installed whole?")


def join_lines(message: str) -> str:
    """Return the driver's message on one line: property, requested value, what can be selected.

    Left out is what the error says anyway, the status code, and the name of the task, which is
    this program's own.
    """
    lines = [" ".join(line.split()) for line in message.splitlines()]
    told = [line for line in lines if line and not line.startswith(_LEFT_OUT)]
    return " ".join(line if line.endswith((".", ":", ",")) else f"{line};" for line in told).rstrip(
        ".;:, "
    )


@contextmanager
def raise_rig_errors(doing: str) -> Iterator[None]:
    """Turn every failure of driver and package into a `RigError`."""
    try:
        yield
    except FAILURES as error:
        raise make_rig_error(doing, error) from error


@contextmanager
def divert_warnings(note: Callable[[int], None]) -> Iterator[None]:
    """Count the driver's warnings instead of printing one in every tick."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", DaqWarning)
        show = warnings.showwarning

        def divert(message: Any, category: type[Warning], *where: Any, **options: Any) -> None:
            if isinstance(message, DaqWarning):
                note(message.error_code)
            else:
                show(message, category, *where, **options)

        warnings.showwarning = divert
        yield


_task_number = count()


def _make_task(purpose: str) -> Task:
    """Make a task. Its name is ASCII whatever the locale, and unique in this process."""
    return Task(f"pamctl_{purpose}_{os.getpid()}_{next(_task_number)}")


@contextmanager
def make_valve_task(settings: NidaqSettings) -> Iterator[Task]:
    """Make the output's task, not yet started."""
    with _make_task("valve") as task:
        task.ao_channels.add_ao_voltage_chan(
            f"{settings.device}/{settings.valve_channel}",
            # A second guard of the range, in the driver.
            min_val=settings.output_low_v,
            max_val=settings.output_high_v,
        )
        yield task


@contextmanager
def make_pressure_task(settings: NidaqSettings) -> Iterator[Task]:
    """Make the analog input's task, not yet started."""
    with _make_task("pressure") as task:
        task.ai_channels.add_ai_voltage_chan(
            f"{settings.device}/{settings.pressure_channel}",
            # The default is differential: the sensor's ground would be left unconnected.
            terminal_config=TerminalConfiguration[settings.terminal.upper()],
            min_val=settings.input_low_v,
            max_val=settings.input_high_v,
        )
        yield task


@contextmanager
def make_encoder_task(settings: NidaqSettings) -> Iterator[Task]:
    """Make the counter's task, not yet started."""
    with _make_task("encoder") as task:
        channel = task.ci_channels.add_ci_lin_encoder_chan(
            f"{settings.device}/{settings.encoder_counter}",
            decoding_type=EncoderType.X_4,
            # The index would reset the count in the middle of a motion.
            zidx_enable=False,
            # The scale is in the calibration only.
            units=LengthUnits.TICKS,
            initial_pos=0.0,
        )
        if settings.encoder_a_pfi is not None:
            channel.ci_encoder_a_input_term = f"/{settings.device}/PFI{settings.encoder_a_pfi}"
            channel.ci_encoder_b_input_term = f"/{settings.device}/PFI{settings.encoder_b_pfi}"
        if settings.encoder_filter_ns:
            shortest_pulse_s = settings.encoder_filter_ns / 1e9
            channel.ci_encoder_a_input_dig_fltr_min_pulse_width = shortest_pulse_s
            channel.ci_encoder_a_input_dig_fltr_enable = True
            channel.ci_encoder_b_input_dig_fltr_min_pulse_width = shortest_pulse_s
            channel.ci_encoder_b_input_dig_fltr_enable = True
        yield task


def make_valve_writer(task: Task) -> Callable[[float, float], None]:
    """Return a function that writes volts within a timeout (s); the task must run."""
    write: Callable[[float, float], None] = AnalogSingleChannelWriter(
        task.out_stream, auto_start=False
    ).write_one_sample
    return write


def make_count_reader(task: Task) -> Callable[[float], float]:
    """Return a function that reads the counter within a timeout (s)."""
    read: Callable[[float], float] = CounterReader(task.in_stream).read_one_sample_double
    return read


def make_volt_reader(task: Task) -> Callable[[float], float]:
    """Return a function that reads the input's volts within a timeout (s)."""
    read: Callable[[float], float] = AnalogSingleChannelReader(task.in_stream).read_one_sample
    return read


class TaskCalls(NamedTuple):
    """The calls of the running tasks; each takes its timeout (s) last."""

    write_v: Callable[[float, float], None]
    read_count: Callable[[float], float]
    read_v: Callable[[float], float]


def tell_encoder_terminals(task: Task) -> list[str]:
    """Return where the counter takes A and B from; empty where the driver does not say."""
    with _accept_what_is_not_offered():
        (channel,) = task.ci_channels
        return [str(channel.ci_encoder_a_input_term), str(channel.ci_encoder_b_input_term)]
    return []


_TRANSFER = {
    ChannelType.ANALOG_INPUT: "ai_data_xfer_mech",
    ChannelType.ANALOG_OUTPUT: "ao_data_xfer_mech",
    ChannelType.COUNTER_INPUT: "ci_data_xfer_mech",
}
"""Property of each kind of channel: what moves its data between card and memory."""


def request_programmed_io(task: Task) -> None:
    """Let the processor itself move each value; a driver that does not offer it keeps its own."""
    for channel in task.channels:
        with _accept_what_is_not_offered():
            setattr(channel, _TRANSFER[channel.chan_type], DataTransferActiveTransferMode.POLLED)


def tell_data_transfer(task: Task) -> str:
    """Return what moves the task's data, such as POLLED; empty where the driver does not say."""
    with _accept_what_is_not_offered():
        mechanisms = {getattr(one, _TRANSFER[one.chan_type]).name for one in task.channels}
        return ", ".join(sorted(mechanisms))
    return ""


def request_wait_by_interrupt(task: Task) -> str:
    """Let a read sleep until the card interrupts; return the mode that the driver then has.

    A read that polls keeps the processor busy. At real-time priority the kernel then stops the
    loop for 50 ms of every second.
    """
    with _accept_what_is_not_offered():
        task.in_stream.wait_mode = WaitMode.WAIT_FOR_INTERRUPT
    with _accept_what_is_not_offered():
        return str(task.in_stream.wait_mode.name)
    return ""


@contextmanager
def _accept_what_is_not_offered() -> Iterator[None]:
    try:
        yield
    except DaqError as error:
        if error.error_code not in NOT_OFFERED:
            raise
