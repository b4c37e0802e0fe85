"""The NI card through NI-DAQmx, paced by the computer or by its own sample clock.

On demand, the loop's clock decides when; each read or write is one driver call of some
microseconds. Hardware-timed, the converter samples at a fixed rate, whatever the computer does.
At the same edges the counter is latched and the output is updated. A tick begins when the
blocking read of an edge's sample returns, so the card paces the loop. What the loop writes is put
out at the next edge, exactly one tick later.

NI's driver has a function that waits for the next edge and says whether it came too late. NI's
Python package does not offer it, and this project does not bypass the package. A missed edge
shows in the time between two reads, and in the driver's lateness codes where it gives them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from typing import Any, ParamSpec, TypeVar

from nidaqmx.constants import AcquisitionType
from nidaqmx.errors import DaqError

from hal.card import CardRig, unwrap_count
from hal.nidaq.card_settings import LATE, NidaqSettings
from hal.nidaq.driver import (
    FAILURES,
    NO_DRIVER,
    TaskCalls,
    divert_warnings,
    make_count_reader,
    make_encoder_task,
    make_pressure_task,
    make_rig_error,
    make_valve_task,
    make_valve_writer,
    make_volt_reader,
    raise_rig_errors,
    request_programmed_io,
    request_wait_by_interrupt,
    require_card,
    tell_data_transfer,
    tell_encoder_terminals,
)
from hal.rig import Edge, RawSample, RigError, RigIdentity


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


_LATE_TRIES = 3

P = ParamSpec("P")
R = TypeVar("R")


class HardwareTimedRig(NidaqRig):
    """Valve, pressure sensor and encoder, all three on the sample clock of the input."""

    def __init__(self, settings: NidaqSettings, *, rate_hz: float, **options: Any) -> None:
        """`rate_hz` is the rate of the sample clock and of the loop; the rest as `CardRig`."""
        super().__init__(settings, **options)
        self._rate_hz = rate_hz
        self._grid = self._make_grid()
        self._awaited: tuple[Edge, float] | None = None

    def await_edge(self) -> Edge:
        """Wait for a sample that has not been read yet; `read` then returns it.

        Raises `RigError` where the card does not sample within the timeout.
        """
        wired = self._require_open()
        with raise_rig_errors("waiting for the card's next sample"):
            volts = wired.read_v(self._settings.timeout_s)
        edge = self._grid.place(self._now_ns())
        self._awaited = edge, volts
        return edge

    def read(self) -> RawSample:
        """Return the sample of the edge that was awaited last, or await the next one."""
        wired = self._require_open()
        if self._awaited is None:
            self.await_edge()
        assert self._awaited is not None
        (edge, volts), self._awaited = self._awaited, None
        with raise_rig_errors("reading the encoder"):
            counts = self._unwrap(wired.read_count(self._settings.timeout_s))
        return RawSample(volts, counts, edge.t_ns, edge.t_ns)

    def describe(self) -> RigIdentity:
        """Add the clock, its rate, and the output's delay to what is wired."""
        identity = super().describe()
        return identity._replace(
            output_delay_ticks=1,
            sample_clock=self._sample_clock,
            extra={**identity.extra, "sample_rate_hz": self._rate_hz},
        )

    @property
    def _sample_clock(self) -> str:
        return f"/{self._settings.device}/ai/SampleClock"

    def _make_grid(self) -> EdgeGrid:
        return EdgeGrid(round(1e9 / self._rate_hz))

    def _wire(self, acquired: ExitStack) -> TaskCalls:
        """Start the tasks that follow the clock before the task that makes it.

        The safe voltage goes out on demand before that, because the sample clock has no edges
        yet. The tasks stop in the order output, input, counter.
        """
        settings = self._settings
        self._count_warnings(acquired)
        self._write_safe_alone()
        self._identity = require_card(settings)
        encoder = acquired.enter_context(make_encoder_task(settings))
        self._identity = {**self._identity, "encoder_terminals": tell_encoder_terminals(encoder)}
        pressure = acquired.enter_context(make_pressure_task(settings))
        valve = acquired.enter_context(make_valve_task(settings))
        point = AcquisitionType.HW_TIMED_SINGLE_POINT
        pressure.timing.cfg_samp_clk_timing(self._rate_hz, sample_mode=point)
        for follower in (encoder, valve):
            follower.timing.cfg_samp_clk_timing(
                self._rate_hz, source=self._sample_clock, sample_mode=point
            )
        if settings.data_transfer == "polled":
            for task in (encoder, pressure, valve):
                request_programmed_io(task)
        self._identity = {
            **self._identity,
            "wait_mode": request_wait_by_interrupt(pressure),
            "data_transfer_in_use": {
                name: tell_data_transfer(task)
                for name, task in (("input", pressure), ("counter", encoder), ("output", valve))
            },
        }
        for task in (encoder, valve, pressure):
            task.start()
        self._grid, self._awaited = self._make_grid(), None
        return TaskCalls(
            self._retry_if_late(make_valve_writer(valve)),
            self._retry_if_late(make_count_reader(encoder)),
            self._retry_if_late(make_volt_reader(pressure)),
        )

    def _retry_if_late(self, call: Callable[P, R]) -> Callable[P, R]:
        """Repeat a call that came too late for its edge, and count it."""

        def patient(*arguments: P.args, **options: P.kwargs) -> R:
            for _ in range(_LATE_TRIES):
                try:
                    return call(*arguments, **options)
                except DaqError as error:
                    if error.error_code not in LATE:
                        raise
                    self._note_warning(error.error_code)
            return call(*arguments, **options)

        return patient

    def _write_safe_as_wired(self, wired: TaskCalls) -> None:
        """Write the safe voltage and wait until it is out."""
        super()._write_safe_as_wired(wired)
        self._awaited = None
        # One unread sample may be waiting; the edge of the next one comes after the write.
        for _ in range(2):
            wired.read_v(self._settings.timeout_s)


class EdgeGrid:
    """Finds the edge that a read belongs to, from the time of its return.

    This is right for reads that return within nine tenths of a period after their edge.
    """

    def __init__(self, period_ns: int) -> None:
        """`period_ns` is the distance of two edges by the card's clock."""
        self._period_ns = period_ns
        # The grid runs this much slower than nominal, twice the difference of two good crystals:
        # a read that returns early can pull the grid back, and nothing can push it forward.
        self._creep_ns = period_ns // 10_000
        # A return this little before an edge belongs to that edge, not to the one before.
        self._slack_ns = period_ns // 20
        self._t_ns: int | None = None

    def place(self, now_ns: int) -> Edge:
        """Return the edge of a read that returned at `now_ns`; the first counts as prompt."""
        if self._t_ns is None:
            self._t_ns = now_ns
            return Edge(now_ns, now_ns, 1)
        elapsed = max(1, (now_ns - self._t_ns + self._slack_ns) // self._period_ns)
        due_ns = self._t_ns + elapsed * (self._period_ns + self._creep_ns)
        self._t_ns = min(due_ns, now_ns)
        return Edge(self._t_ns, now_ns, elapsed)
