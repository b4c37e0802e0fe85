"""Measured times: waking up on the loop's grid, and each call of the rig."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from hal.doctor_finding import DoctorFinding, Level
from hal.rig import Rig
from pamctl.realtime.clock import Clock
from pamctl.realtime.tick_runner import TickCost

CALLS = 2000
_LONGEST_S = 2.0
"""Longest time spent on measuring calls: a slow rig has shown itself by then."""
_EDGES_US = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)

_GOOD_SHARE, _BAD_SHARE = 0.05, 0.5
"""Shares of a period at the 99th percentile: up to the first is ok, above the second a fault."""


class LatencySpread(NamedTuple):
    """Statistics of durations, in microseconds."""

    samples: int
    p50_us: float
    p99_us: float
    max_us: float
    histogram: dict[str, int]
    """Number of durations below each edge and not below the edge before."""

    def __str__(self) -> str:
        """Return one phrase for people."""
        return f"p50 {self.p50_us:.1f}, p99 {self.p99_us:.1f}, max {self.max_us:.1f} us"


def summarise_latencies(durations_ns: Sequence[int]) -> LatencySpread:
    """Return the statistics of at least one duration; percentiles are values that occurred."""
    ordered = sorted(durations_ns)
    last = len(ordered) - 1

    def quantile_us(share: float) -> float:
        return ordered[math.ceil(share * last)] * 1e-3

    edges = (*_EDGES_US, math.inf)
    counts = dict.fromkeys((f"below_{edge}_us" for edge in edges), 0)
    for duration_ns in ordered:
        edge = next(edge for edge in edges if duration_ns < edge * 1e3)
        counts[f"below_{edge}_us"] += 1
    histogram = {name: count for name, count in counts.items() if count}
    return LatencySpread(
        len(ordered), quantile_us(0.5), quantile_us(0.99), ordered[-1] * 1e-3, histogram
    )


# --- waking up -------------------------------------------------------------------------------


class WakeUps(NamedTuple):
    """How late a clock woke up, and how many of its grid points passed unused."""

    late: LatencySpread
    missed: int


def measure_wake_ups(clock: Clock, duration_s: float) -> WakeUps:
    """Wait for the grid again and again; this needs only a clock."""
    ticks = max(10, round(duration_s * 1e9 / clock.period_ns))
    late_ns, missed = [], 0
    with _pause_garbage_collection():
        last = clock.wait().tick + ticks
        while True:
            wake = clock.wait()
            late_ns.append(wake.now_ns - wake.deadline_ns)
            missed += wake.missed
            if wake.tick >= last:
                return WakeUps(summarise_latencies(late_ns), missed)


def judge_wake_ups(name: str, wake_ups: WakeUps, period_s: float, how: str) -> DoctorFinding:
    """Judge a measurement against the loop's period; `how` names the scheduling."""
    late, missed = wake_ups
    ticks = late.samples + missed
    level = _judge_share(late.p99_us * 1e-6 / period_s)
    if missed and level == "ok":
        level = "fault" if missed > 0.01 * ticks else "warning"
    return DoctorFinding(
        name,
        level,
        f"{how}: late by {late}, {missed} of {ticks} ticks missed",
        f"p99 below {_GOOD_SHARE * period_s * 1e6:.0f} us and no tick missed",
        "grant what pc.fifo and pc.dma_latency name; close other programs; give a virtual machine "
        "its own processors; a PREEMPT_RT kernel bounds the maximum",
        {**late._asdict(), "missed": missed, "period_s": period_s},
    )


# --- calls of the rig ------------------------------------------------------------------------


class CallCosts(NamedTuple):
    """Times of the three calls of a tick."""

    encoder: LatencySpread
    pressure: LatencySpread
    output: LatencySpread


def measure_calls(
    rig: Rig, safe_volts: float, now_ns: Callable[[], int] = time.monotonic_ns, calls: int = CALLS
) -> CallCosts:
    """Read and write the safe voltage back to back; the rig is open.

    The times in a sample separate the encoder's call from the pressure sensor's: encoder first.
    """
    encoder_ns, pressure_ns, output_ns = [], [], []
    until_ns = now_ns() + round(_LONGEST_S * 1e9)
    with _pause_garbage_collection():
        for _ in range(calls):
            sample = rig.read()
            read_ns = now_ns()
            rig.write(safe_volts)
            written_ns = now_ns()
            encoder_ns.append(sample.pressure_t_ns - sample.encoder_t_ns)
            pressure_ns.append(read_ns - sample.pressure_t_ns)
            output_ns.append(written_ns - read_ns)
            if written_ns > until_ns:
                break
    return CallCosts(
        summarise_latencies(encoder_ns),
        summarise_latencies(pressure_ns),
        summarise_latencies(output_ns),
    )


def judge_calls(calls: CallCosts, period_s: float) -> Iterator[DoctorFinding]:
    """Judge each call against a third of the time that all three may take of a tick."""
    for name, cost in calls._asdict().items():
        level = _judge_share(3.0 * cost.p99_us * 1e-6 / period_s)
        if level == "ok" and cost.max_us * 1e-6 > period_s:
            level = "warning"
        yield DoctorFinding(
            f"latency.{name}",
            level,
            f"{cost} of {cost.samples} calls",
            f"p99 below {_GOOD_SHARE * period_s * 1e6 / 3:.0f} us, and none longer than a tick",
            "is the card on PCI or PCIe (a USB device takes a millisecond a call)? close other "
            "programs that use it; see pc.fifo; or lower loop.rate_hz",
            cost._asdict(),
        )


def judge_rate(calls: CallCosts, rehearsed_s: float, period_s: float) -> DoctorFinding:
    """Judge whether the loop can hold its rate: its own work, and the calls of the rig."""
    calls_s = sum(cost.p99_us for cost in calls) * 1e-6
    cost = TickCost.estimate(rehearsed_s, calls_s)
    rate_hz = 1.0 / period_s
    level: Level = "ok" if rate_hz <= cost.held_hz else "warning"
    if cost.live_s > period_s:
        level = "fault"
    return DoctorFinding(
        "latency.rate",
        level,
        f"a tick takes about {cost.live_s * 1e6:.0f} us, {calls_s * 1e6:.0f} us of them in the "
        f"rig's calls (p99): up to {cost.held_hz:.0f} Hz can be held",
        f"{rate_hz:.0f} Hz, as loop.rate_hz says",
        "lower loop.rate_hz; or close other programs, see pc.wakeup",
        {**cost._asdict(), "calls_s": calls_s, "rate_hz": rate_hz},
    )


def _judge_share(share: float) -> Level:
    return "ok" if share <= _GOOD_SHARE else "warning" if share <= _BAD_SHARE else "fault"


@contextmanager
def _pause_garbage_collection() -> Iterator[None]:
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
