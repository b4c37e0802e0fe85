"""The NI card paced by its own sample clock: hardware-timed single points.

The converter samples at a fixed rate, whatever the computer does. At the same edges the counter
is latched and the output is updated. A tick begins when the blocking read of an edge's sample
returns, so the card paces the loop. What the loop writes is put out at the next edge, exactly one
tick later.

NI's driver has a function that waits for the next edge and says whether it came too late. NI's
Python package does not offer it, and this project does not bypass the package. A missed edge
shows in the time between two reads, and in the driver's lateness codes where it gives them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, ParamSpec, TypeVar

from nidaqmx.constants import AcquisitionType
from nidaqmx.errors import DaqError

from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.driver import raise_rig_errors, require_card
from hal.nidaq.driver_errors import LATE
from hal.nidaq.edges import EdgeGrid
from hal.nidaq.on_demand import NidaqRig
from hal.nidaq.tasks import (
    TaskCalls,
    make_count_reader,
    make_encoder_task,
    make_pressure_task,
    make_valve_task,
    make_valve_writer,
    make_volt_reader,
    request_programmed_io,
    request_wait_by_interrupt,
    tell_data_transfer,
    tell_encoder_terminals,
)
from hal.rig import Edge, RawSample, RigIdentity

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
