"""Checks of the computer: kernel, permissions, space, waking up in time, each call of the rig."""

from __future__ import annotations

import gc
import math
import os
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from hal.backend import report_check
from hal.problem import Level, Problem
from hal.rig import Rig
from pamctl.processes.interrupts import MASK, can_sleep, keep_awake
from pamctl.realtime.clock import Clock
from pamctl.realtime.scheduling import Preparation
from pamctl.realtime.tick_runner import TickCost

_MB = 1 << 20
_RING_BYTES = 64 * _MB
_LOG_BYTES_PER_S = 250_000
"""Some 200 bytes a tick at 1 kHz, with a margin."""
_SHORTEST_LOG_S = 300.0
_COMFORTABLE_LOG_S = 3600.0

_RIGHTS = {
    "fifo": "SCHED_FIFO, so that no other program delays the loop",
    "mlock": "memory locked, so that no tick waits for a page",
    "dma_latency": "no deep sleep of the processors while the loop runs",
    "affinity": "a processor for the loop alone",
    "timer_slack": "timers without slack",
}


def examine_pc(shared_memory: Path, log_directory: Path) -> Iterator[Problem]:
    """Check what does not depend on the rig and needs no measurement."""
    yield check_kernel()
    yield check_processors(os.cpu_count() or 1)
    yield check_governor(Path("/sys/devices/system/cpu"))
    yield check_sleep()
    yield check_shared_memory(shared_memory)
    yield check_log_disk(log_directory)


def check_kernel() -> Problem:
    """Look for PREEMPT_RT."""
    release, version = platform.release(), platform.version()
    is_real_time = "PREEMPT_RT" in version or _read_text(Path("/sys/kernel/realtime")) == "1"
    return report_check(
        "pc.kernel",
        "ok" if is_real_time else "warning",
        f"{platform.system()} {release}, {'' if is_real_time else 'not '}PREEMPT_RT",
        "PREEMPT_RT, which bounds the rare long delays",
        "apt install linux-image-rt-amd64 (Debian) or pro enable realtime-kernel (Ubuntu); "
        "runs work without, see pc.wakeup",
        {"release": release, "preempt_rt": is_real_time},
    )


def check_processors(count: int) -> Problem:
    """Count the processors: the loop needs one for itself."""
    return report_check(
        "pc.processors",
        "ok" if count > 1 else "warning",
        f"{count}",
        "at least 2: one for the loop, one for everything else",
        "give the machine a second processor; the loop will not spin on this one",
        {"processors": count},
    )


def check_governor(cpus: Path) -> Problem:
    """Check that the processors do not lower their clock rate."""
    files = sorted(cpus.glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({_read_text(file) for file in files})
    if not governors:
        found = "not visible (a virtual machine, or the firmware's own)"
        return report_check("pc.governor", "ok", found, data={"governors": []})
    level: Level = "ok" if governors == ["performance"] else "warning"
    return report_check(
        "pc.governor",
        level,
        ", ".join(governors),
        "performance",
        "cpupower frequency-set -g performance",
        {"governors": governors},
    )


def check_sleep() -> Problem:
    """Check that the PC does not go to sleep during a run: the card would hold its voltage."""
    name = "pc.sleep"
    if not can_sleep():
        return report_check(name, "ok", "this PC cannot be suspended", data={"may_suspend": False})
    with keep_awake() as risk:
        data = {"may_suspend": bool(risk)}
    if not risk:
        return report_check(name, "ok", "may be suspended, but not during a run", data=data)
    return report_check(name, "warning", risk.partition(";")[0], "no sleep in a run", MASK, data)


def check_shared_memory(directory: Path) -> Problem:
    """Check that shared memory has room for rings and locks."""
    name, wanted = "pc.shared_memory", f"writable, {_RING_BYTES // _MB} MB free for ring and locks"
    if not (directory.is_dir() and os.access(directory, os.W_OK)):
        fix = f"mount -t tmpfs -o mode=1777 tmpfs {directory}"
        return report_check(name, "fault", f"{directory} cannot be written", wanted, fix)
    free = _free_bytes(directory)
    return report_check(
        name,
        "ok" if free >= _RING_BYTES else "fault",
        f"{directory}: {free // _MB} MB free",
        wanted,
        f"remove what fills {directory} (ls -l {directory}); the next `pamctl run` recovers "
        "the ring of a run that died",
        {"free_bytes": free},
    )


def check_log_disk(directory: Path) -> Problem:
    """Check how long a log may become."""
    place = next(path for path in (directory, *directory.absolute().parents) if path.is_dir())
    if not os.access(place, os.W_OK):
        fix = "change to a directory that you may write, or give --log to each run"
        return report_check("pc.log_disk", "fault", f"{place} cannot be written", "writable", fix)
    free = _free_bytes(place)
    lasts_s = free / _LOG_BYTES_PER_S
    level: Level = (
        "fault"
        if lasts_s < _SHORTEST_LOG_S
        else "warning"
        if lasts_s < _COMFORTABLE_LOG_S
        else "ok"
    )
    return report_check(
        "pc.log_disk",
        level,
        f"{place}: {free // _MB} MB free, logs of {lasts_s / 3600:.1f} h",
        f"room for an hour ({_LOG_BYTES_PER_S * 3600 // _MB} MB)",
        "remove old logs, or log to another disk with --log",
        {"free_bytes": free, "log_s": lasts_s},
    )


def judge_permissions(preparation: Preparation) -> Iterator[Problem]:
    """Say which steps of the preparation for real time this user is permitted."""
    for step in preparation.steps:
        if step.name not in _RIGHTS:
            continue
        # A refusal worsens the timing, never the run. `--rt require` makes it an error.
        level: Level = "ok" if step.done else "warning"
        reason, _, fix = step.detail.partition("; ")
        yield report_check(
            f"pc.{step.name}",
            level,
            step.detail if step.done else f"refused: {reason}",
            _RIGHTS[step.name],
            "" if step.done else fix,
            {"permitted": step.done},
        )


def _free_bytes(place: Path) -> int:
    disk = os.statvfs(place)
    return disk.f_bavail * disk.f_frsize


def _read_text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


CALLS = 2000
_LONGEST_S = 2.0
"""Longest time spent on measuring calls: a slow rig has shown itself by then."""

_GOOD_SHARE, _BAD_SHARE = 0.05, 0.5
"""Shares of a period at the 99th percentile: up to the first is ok, above the second a fault."""


class LatencySpread(NamedTuple):
    """Statistics of durations, in microseconds."""

    samples: int
    p50_us: float
    p99_us: float
    max_us: float

    def __str__(self) -> str:
        """Return one phrase for people."""
        return f"p50 {self.p50_us:.1f}, p99 {self.p99_us:.1f}, max {self.max_us:.1f} us"


def summarise_latencies(durations_ns: Sequence[int]) -> LatencySpread:
    """Return the statistics of at least one duration; percentiles are values that occurred."""
    ordered = sorted(durations_ns)
    last = len(ordered) - 1

    def quantile_us(share: float) -> float:
        return ordered[math.ceil(share * last)] * 1e-3

    return LatencySpread(len(ordered), quantile_us(0.5), quantile_us(0.99), ordered[-1] * 1e-3)


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


def judge_wake_ups(name: str, wake_ups: WakeUps, period_s: float, how: str) -> Problem:
    """Judge a measurement against the loop's period; `how` names the scheduling."""
    late, missed = wake_ups
    ticks = late.samples + missed
    level = _judge_share(late.p99_us * 1e-6 / period_s)
    if missed and level == "ok":
        level = "fault" if missed > 0.01 * ticks else "warning"
    return report_check(
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


def measure_calls(rig: Rig, safe_volts: float, calls: int = CALLS) -> CallCosts:
    """Read and write the safe voltage back to back; the rig is open.

    The times in a sample separate the encoder's call from the pressure sensor's: encoder first.
    """
    encoder_ns, pressure_ns, output_ns = [], [], []
    now_ns = time.monotonic_ns
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


def judge_calls(calls: CallCosts, period_s: float) -> Iterator[Problem]:
    """Judge each call against a third of the time that all three may take of a tick."""
    for name, cost in calls._asdict().items():
        level = _judge_share(3.0 * cost.p99_us * 1e-6 / period_s)
        if level == "ok" and cost.max_us * 1e-6 > period_s:
            level = "warning"
        yield report_check(
            f"latency.{name}",
            level,
            f"{cost} of {cost.samples} calls",
            f"p99 below {_GOOD_SHARE * period_s * 1e6 / 3:.0f} us, and none longer than a tick",
            "is the card on PCI or PCIe (a USB device takes a millisecond a call)? close other "
            "programs that use it; see pc.fifo; or lower loop.rate_hz",
            cost._asdict(),
        )


def judge_rate(calls: CallCosts, rehearsed_s: float, period_s: float) -> Problem:
    """Judge whether the loop can hold its rate: its own work, and the calls of the rig."""
    calls_s = sum(cost.p99_us for cost in calls) * 1e-6
    cost = TickCost.estimate(rehearsed_s, calls_s)
    rate_hz = 1.0 / period_s
    level: Level = "ok" if rate_hz <= cost.held_hz else "warning"
    if cost.live_s > period_s:
        level = "fault"
    return report_check(
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
