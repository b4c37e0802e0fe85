"""What a tick costs on this computer: measured before the rig is open, for the loop's rate."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from statistics import median
from typing import NamedTuple

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.control.course import make_valve_reference
from pamctl.realtime.clock import Wake
from pamctl.realtime.tick import TickSetup, first_state
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.ring import ROW_BYTES
from pamctl.signals import (
    Phase,
    Reference,
    TickOutcome,
    Truth,
)

_REHEARSALS = 100
"""Some milliseconds in all."""

LIVE_FACTOR = 6.0
"""A tick after a sleep finds cold caches. Measured on two busy cores over the simulated rig: 7.5 us
rehearsed; live, with its reads and writes, 27 us (p50) to 43 us (p99) at 10 kHz."""

BUSY_SHARE = 0.5
"""Share of the period that ticks may take; the rest is for waking up late and for the slack."""


class TickCost(NamedTuple):
    """What one tick is estimated to take, and the highest rate that this allows."""

    rehearsed_s: float
    live_s: float
    held_hz: float

    @classmethod
    def estimate(cls, rehearsed_s: float, calls_s: float = 0.0) -> TickCost:
        """Estimate from a rehearsal; `calls_s` is what the calls of a real rig add."""
        live_s = LIVE_FACTOR * rehearsed_s + calls_s
        return cls(rehearsed_s, live_s, BUSY_SHARE / live_s)

    def find_warning(self, rate_hz: float) -> str:
        """Return one line if the loop cannot hold this rate; empty if it can."""
        if rate_hz <= self.held_hz:
            return ""
        return (
            f"rate_hz {rate_hz:g} leaves {1e6 / rate_hz:.0f} us for a tick that takes about "
            f"{self.live_s * 1e6:.0f} us on this PC: ticks will be missed. About "
            f"{self.held_hz:.0f} Hz can be held, less with a slow card: see `pamctl doctor`"
        )


def rehearse_tick_s(
    setup: TickSetup,
    period_s: float,
    now_ns: Callable[[], int] = time.perf_counter_ns,
    tick: TickRunner | None = None,
) -> float:
    """Return the median time of a tick without rig and clock: step, record, packing (s).

    `tick` runs it; it must begin afresh afterwards.
    """
    tick, journal = tick or TickRunner(setup), _OneRow()
    sensor_v = 0.5 * (setup.limits.sensor_low_v + setup.limits.sensor_high_v)
    period_ns = round(period_s * 1e9)
    tick.begin(first_state(setup, Zero(sensor_v, 0.0)), 0, -period_ns)
    references = (
        make_valve_reference(Phase.OPEN_LOOP, setup.limits.safe_valve_v),
        Reference(Phase.TRACK, 0.0, 0.0, 0.0, 0.0, math.nan),
    )
    outcome, truth = TickOutcome(0.0, 0.0, 0.0, 0.0), Truth(math.nan, math.nan)
    took_ns = []
    for at in range(_REHEARSALS):
        t_ns = at * period_ns
        raw, wake = RawSample(sensor_v, 0, t_ns, t_ns), Wake(at, t_ns, t_ns, 0)
        reference = references[at > 0]  # the law begins from rest
        began_ns = now_ns()
        tick.time(wake, raw)
        tick.run(setup, wake, raw, reference)
        tick.record(journal, outcome, truth)
        took_ns.append(now_ns() - began_ns)
    return median(took_ns) * 1e-9


class _OneRow:
    """Takes each tick as the ring does, into one row."""

    def __init__(self) -> None:
        self._row = bytearray(ROW_BYTES)

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        self._row[:] = row

    def rehearse_row(self, row: bytearray) -> None:
        self._row[:] = row
