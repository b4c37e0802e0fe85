"""The NI card through NI-DAQmx, paced by the computer.

On-demand timing: the loop's clock decides when, and each read or write is one driver call of
some microseconds. This holds only for tasks that already run, through the stream readers and
writers. `Task.read` and `Task.write` cost ten times as much. A task that does not run is started
and stopped by every call, which sets the encoder back to zero each time.

An M Series card has no watchdog and holds its last output voltage when a task stops, a process
dies, or the driver unloads. So `open` writes the safe voltage first, and every way out writes
it last.
"""

from __future__ import annotations

import ctypes
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from typing import Any, NamedTuple

from nidaqmx import Task
from nidaqmx.constants import BusType, EncoderType, LengthUnits, TerminalConfiguration
from nidaqmx.errors import DaqError, DaqNotFoundError, DaqNotSupportedError, DaqWarning
from nidaqmx.errors import Error as DriverError
from nidaqmx.stream_readers import AnalogSingleChannelReader, CounterReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter
from nidaqmx.system import Device, System

from hal.converter import nearest_output_v
from hal.driver_library import find_loaded_library, refuse_stand_in
from hal.m_series import card_output, unwrap_count
from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.driver_errors import INSTALL, ON_DEMAND, fix_of
from hal.rig import RawSample, RigError, RigIdentity
from hal.safe_drive import drive_with_retries

LIBRARY = "libnidaqmx.so"

STAND_IN_SERIAL = 0xDECAF
"""Serial number of the driver that stands in for a card in this project's tests."""

_TIMED_BUSES = (BusType.PCI, BusType.PCIE, BusType.PXI, BusType.PXIE)

_NO_DRIVER = (DaqNotFoundError, DaqNotSupportedError)
# ArgumentError: ctypes refuses an argument. OSError: the library cannot be loaded.
# ValueError: a count is not a number.
_FAILURES = (DriverError, ctypes.ArgumentError, OSError, ValueError)

_task_number = count()


# --- what is there -----------------------------------------------------------------------


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
        refuse_stand_in(settings.device, str(identity["library"]))
    return identity


# --- errors of the driver ---------------------------------------------------------------


def _make_rig_error(doing: str, error: Exception) -> RigError:
    """Return the driver's message with its error number and its fix."""
    if isinstance(error, _NO_DRIVER):
        return RigError("no NI-DAQmx driver on this computer", fix=INSTALL)
    said = str(error).strip().partition("\n")[0]
    if isinstance(error, DaqError):
        code = error.error_code
        return RigError(f"{doing}: {said}", fix=fix_of(code), code=code)
    return RigError(f"{doing}: {said or type(error).__name__}", fix="is NI-DAQmx installed whole?")


@contextmanager
def raise_rig_errors(doing: str) -> Iterator[None]:
    """Turn every failure of driver and package into a `RigError`."""
    try:
        yield
    except _FAILURES as error:
        raise _make_rig_error(doing, error) from error


@contextmanager
def _divert_warnings(note: Callable[[int], None]) -> Iterator[None]:
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


# --- tasks -------------------------------------------------------------------------------


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


# --- the rig -----------------------------------------------------------------------------


class NidaqRig:
    """Valve, pressure sensor and encoder on one M Series card."""

    def __init__(
        self,
        settings: NidaqSettings,
        *,
        safe_output_v: float,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`safe_output_v` is the analog output voltage at which the rig is safe."""
        self._settings = settings
        self._now_ns = now_ns
        self._output = card_output(settings)
        self._safe_v = nearest_output_v(self._output, safe_output_v)
        self._safe_output_v = safe_output_v
        self._wired: TaskCalls | None = None
        self._tasks = ExitStack()
        self._counts = 0
        self._identity: Mapping[str, object] = {}
        self._warnings: dict[int, int] = {}
        self._safe_failure: Exception | None = None

    def open(self) -> None:
        """Drive the safe voltage, and only then take the inputs."""
        if self._wired is not None:
            raise RigError("the rig is open already", fix="call close() first")
        self._warnings.clear()
        with raise_rig_errors(f"opening {self._settings.device}"), ExitStack() as acquired:
            acquired.enter_context(_divert_warnings(self._note_warning))
            wired = self._wire(acquired)
            self._counts = 0
            self._wired, self._tasks = wired, acquired.pop_all()

    def read(self) -> RawSample:
        """Read the encoder, then the pressure; each time is taken just before its call."""
        wired = self._require_open()
        timeout_s, doing = self._settings.timeout_s, "reading the encoder"
        try:
            encoder_t_ns = self._now_ns()
            reading = wired.read_count(timeout_s)
            doing = "reading the pressure sensor"
            pressure_t_ns = self._now_ns()
            pressure_v = wired.read_v(timeout_s)
        except _FAILURES as error:
            raise _make_rig_error(doing, error) from error
        return RawSample(pressure_v, self._unwrap(reading), pressure_t_ns, encoder_t_ns)

    def write(self, ao_v: float) -> float:
        """Put a voltage on the output: the nearest code within the configured range."""
        wired = self._require_open()
        if not math.isfinite(ao_v):
            raise RigError(f"refused to output {ao_v} V", fix="a law must command a finite voltage")
        admitted_v = nearest_output_v(self._output, ao_v)
        try:
            wired.write_v(admitted_v, self._settings.timeout_s)
        except _FAILURES as error:
            raise _make_rig_error("writing to the valve", error) from error
        return admitted_v

    def make_safe(self) -> None:
        """Drive the safe voltage, over the running task or over one of its own.

        It tries several times, because a killed process may hold the output a moment longer.
        If every try fails, `safe_failure` says why. An output whose task fails twice is
        released and reserved again; to go on, the rig must then be opened again.
        """
        self._safe_failure = drive_with_retries(
            self._drive_safe, lambda error: isinstance(error, _NO_DRIVER)
        )

    def close(self) -> None:
        """Make safe, then release the card; the output holds the safe voltage."""
        self.make_safe()
        self._release()

    def describe(self) -> RigIdentity:
        """Name terminals and ranges; once opened, also card, driver and its warnings so far."""
        extra = self._settings.model_dump()
        if self._identity:
            extra |= {**self._identity, "driver_warnings": self.warnings}
        return RigIdentity("nidaq", self._safe_output_v, extra=extra)

    @property
    def warnings(self) -> Mapping[str, int]:
        """How often the driver gave which warning since `open`, by its number."""
        return {str(code): times for code, times in self._warnings.items()}

    @property
    def safe_failure(self) -> RigError | None:
        """Why the last `make_safe` could not drive the safe voltage; None where it did."""
        failure = self._safe_failure
        return None if failure is None else _make_rig_error("driving the safe voltage", failure)

    def _wire(self, acquired: ExitStack) -> TaskCalls:
        """Write the safe voltage, and only then take the inputs."""
        settings = self._settings
        valve = acquired.enter_context(make_valve_task(settings))
        valve.start()
        write_v = make_valve_writer(valve)
        write_v(self._safe_v, settings.timeout_s)
        self._identity = require_card(settings)
        encoder = acquired.enter_context(make_encoder_task(settings))
        encoder.start()
        pressure = acquired.enter_context(make_pressure_task(settings))
        pressure.start()
        return TaskCalls(write_v, make_count_reader(encoder), make_volt_reader(pressure))

    def _unwrap(self, reading: float) -> int:
        self._counts = unwrap_count(self._counts, round(reading))
        return self._counts

    def _drive_safe(self, as_open: bool) -> None:
        if self._wired is not None and as_open:
            self._write_safe_as_wired(self._wired)
            return
        self._release()
        self._write_on_demand(self._safe_v)

    def _write_safe_as_wired(self, wired: TaskCalls) -> None:
        wired.write_v(self._safe_v, self._settings.timeout_s)

    def _write_on_demand(self, volts: float) -> None:
        """Write through a task made for this write; the output then holds the voltage."""
        with make_valve_task(self._settings) as valve:
            valve.start()
            make_valve_writer(valve)(volts, self._settings.timeout_s)

    def _release(self) -> None:
        self._wired = None
        # Nothing can be done about a task that cannot be cleared.
        with suppress(Exception):
            self._tasks.close()

    def _note_warning(self, code: int) -> None:
        self._warnings[code] = self._warnings.get(code, 0) + 1

    def _require_open(self) -> TaskCalls:
        if self._wired is None:
            raise RigError("the card is not open", fix="call open() first")
        return self._wired
