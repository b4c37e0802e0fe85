"""The NI card through NI-DAQmx, paced by the computer.

On-demand timing: the loop's clock decides when, and each read or write is one driver call of
some microseconds (`tasks.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from typing import Any

from hal.card_rig import CardRig
from hal.m_series import unwrap_count
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


class NidaqRig(CardRig[NidaqSettings, TaskCalls]):
    """Valve, pressure sensor and encoder on one M Series card."""

    def __init__(self, settings: NidaqSettings, **options: Any) -> None:
        """As `CardRig`."""
        super().__init__(settings, **options)
        self._warnings: dict[int, int] = {}

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

    def _explain_opening(self) -> AbstractContextManager[None]:
        return raise_rig_errors(f"opening {self._settings.device}")

    def _explain_failure(self, failure: Exception) -> RigError:
        return make_rig_error("driving the safe voltage", failure)

    def _is_hopeless(self, error: Exception) -> bool:
        return isinstance(error, NO_DRIVER)

    def _wire(self, acquired: ExitStack) -> TaskCalls:
        """Write the safe voltage, and only then take the inputs."""
        settings = self._settings
        self._count_warnings(acquired)
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

    def _put_v(self, wired: TaskCalls, volts: float) -> None:
        try:
            wired.write_v(volts, self._settings.timeout_s)
        except FAILURES as error:
            raise make_rig_error("writing to the valve", error) from error

    def _write_safe_as_wired(self, wired: TaskCalls) -> None:
        wired.write_v(self._safe_v, self._settings.timeout_s)

    def _write_safe_alone(self) -> None:
        """Write through a task made for this write; the output then holds the voltage."""
        with make_valve_task(self._settings) as valve:
            valve.start()
            make_valve_writer(valve)(self._safe_v, self._settings.timeout_s)

    def _count_warnings(self, acquired: ExitStack) -> None:
        """Count the driver's warnings until the card is released."""
        self._warnings.clear()
        acquired.enter_context(divert_warnings(self._note_warning))

    def _note_warning(self, code: int) -> None:
        self._warnings[code] = self._warnings.get(code, 0) + 1
