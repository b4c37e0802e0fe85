"""The NI card through NI-DAQmx, paced by the computer.

On-demand timing: the loop's clock decides when, and each read or write is one driver call of
some microseconds (`tasks.py`).

An M Series card has no watchdog and holds its last output voltage when a task stops, a process
dies, or the driver unloads. So `open` writes the safe voltage first, and every way out writes
it last.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress

from hal.converter import nearest_output_v
from hal.m_series import card_output, unwrap_count
from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.driver import (
    FAILURES,
    NO_DRIVER,
    divert_warnings,
    make_rig_error,
    raise_rig_errors,
    require_card,
)
from hal.nidaq.tasks import (
    TaskCalls,
    make_count_reader,
    make_encoder_task,
    make_pressure_task,
    make_valve_task,
    make_valve_writer,
    make_volt_reader,
    tell_encoder_terminals,
)
from hal.rig import RawSample, RigError, RigIdentity
from hal.safe_drive import drive_with_retries


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
            acquired.enter_context(divert_warnings(self._note_warning))
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
        except FAILURES as error:
            raise make_rig_error(doing, error) from error
        return RawSample(pressure_v, self._unwrap(reading), pressure_t_ns, encoder_t_ns)

    def write(self, ao_v: float) -> float:
        """Put a voltage on the output: the nearest code within the configured range."""
        wired = self._require_open()
        if not math.isfinite(ao_v):
            raise RigError(f"refused to output {ao_v} V", fix="a law must command a finite voltage")
        admitted_v = nearest_output_v(self._output, ao_v)
        try:
            wired.write_v(admitted_v, self._settings.timeout_s)
        except FAILURES as error:
            raise make_rig_error("writing to the valve", error) from error
        return admitted_v

    def make_safe(self) -> None:
        """Drive the safe voltage, over the running task or over one of its own.

        It tries several times, because a killed process may hold the output a moment longer.
        If every try fails, `safe_failure` says why. An output whose task fails twice is
        released and reserved again; to go on, the rig must then be opened again.
        """
        self._safe_failure = drive_with_retries(
            self._drive_safe, lambda error: isinstance(error, NO_DRIVER)
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
        return None if failure is None else make_rig_error("driving the safe voltage", failure)

    def _wire(self, acquired: ExitStack) -> TaskCalls:
        """Write the safe voltage, and only then take the inputs."""
        settings = self._settings
        valve = acquired.enter_context(make_valve_task(settings))
        valve.start()
        write_v = make_valve_writer(valve)
        write_v(self._safe_v, settings.timeout_s)
        self._identity = require_card(settings)
        encoder = acquired.enter_context(make_encoder_task(settings))
        self._identity = {**self._identity, "encoder_terminals": tell_encoder_terminals(encoder)}
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
