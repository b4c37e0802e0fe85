"""What a tick costs on this computer: measured before the rig is open, for the loop's rate."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from itertools import chain
from statistics import median
from typing import NamedTuple

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.control.course import make_valve_reference
from pamctl.realtime.tick import TickSetup, first_state, step
from pamctl.recording.ring import tick_struct
from pamctl.signals import (
    Phase,
    Reference,
    TickOutcome,
    TickRecord,
    Timing,
    Truth,
    list_tick_fields,
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
    setup: TickSetup, period_s: float, now_ns: Callable[[], int] = time.perf_counter_ns
) -> float:
    """Return the median time of a tick without rig and clock: step, record, packing (s)."""
    packing = tick_struct(list_tick_fields(setup.compensation is not None))
    row = bytearray(packing.size)
    sensor_v = 0.5 * (setup.limits.sensor_low_v + setup.limits.sensor_high_v)
    state = first_state(setup, Zero(sensor_v, 0.0))
    references = (
        make_valve_reference(Phase.OPEN_LOOP, setup.limits.safe_valve_v),
        Reference(Phase.TRACK, 0.0, 0.0, 0.0, 0.0, math.nan),
    )
    outcome, truth = TickOutcome(0.0, 0.0, 0.0, 0.0), Truth(math.nan, math.nan)
    took_ns = []
    for tick in range(_REHEARSALS):
        t_ns = round(tick * period_s * 1e9)
        raw = RawSample(sensor_v, 0, t_ns, t_ns)
        reference = references[tick > 0]  # the law begins from rest
        began_ns = now_ns()
        timing = Timing(tick, tick * period_s, period_s, 0.0, 0)
        state, decision = step(setup, state, raw, reference, timing)
        record = TickRecord(
            timing,
            raw,
            state.measurement,
            reference,
            state.estimate,
            state.command,
            decision,
            outcome,
            truth,
            state.compensated or (),
        )
        packing.pack_into(row, 0, *chain(*record))
        took_ns.append(now_ns() - began_ns)
    return median(took_ns) * 1e-9
