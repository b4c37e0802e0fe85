"""Checks of the computer: kernel, processors, permissions, space for rings and logs."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from pathlib import Path

from hal.doctor_finding import DoctorFinding, Level
from pamctl.processes.keep_awake import MASK, can_sleep, keep_awake
from pamctl.realtime.scheduling import Preparation

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


def examine_pc(shared_memory: Path, log_directory: Path) -> Iterator[DoctorFinding]:
    """Check what does not depend on the rig and needs no measurement."""
    yield check_kernel()
    yield check_processors(os.cpu_count() or 1)
    yield check_governor(Path("/sys/devices/system/cpu"))
    yield check_sleep()
    yield check_shared_memory(shared_memory)
    yield check_log_disk(log_directory)


def check_kernel() -> DoctorFinding:
    """Look for PREEMPT_RT."""
    release, version = platform.release(), platform.version()
    is_real_time = "PREEMPT_RT" in version or _read_text(Path("/sys/kernel/realtime")) == "1"
    found = f"{platform.system()} {release}, {'' if is_real_time else 'not '}PREEMPT_RT"
    data = {"release": release, "preempt_rt": is_real_time}
    if is_real_time:
        return DoctorFinding("pc.kernel", "ok", found, data=data)
    return DoctorFinding(
        "pc.kernel",
        "warning",
        found,
        "PREEMPT_RT, which bounds the rare long delays",
        "apt install linux-image-rt-amd64 (Debian) or pro enable realtime-kernel (Ubuntu); "
        "runs work without, see pc.wakeup",
        data,
    )


def check_processors(count: int) -> DoctorFinding:
    """Count the processors: the loop needs one for itself."""
    data = {"processors": count}
    if count > 1:
        return DoctorFinding("pc.processors", "ok", f"{count}", data=data)
    return DoctorFinding(
        "pc.processors",
        "warning",
        "1",
        "at least 2: one for the loop, one for everything else",
        "give the machine a second processor; the loop will not spin on this one",
        data,
    )


def check_governor(cpus: Path) -> DoctorFinding:
    """Check that the processors do not lower their clock rate."""
    files = sorted(cpus.glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({_read_text(file) for file in files})
    if not governors:
        found = "not visible (a virtual machine, or the firmware's own)"
        return DoctorFinding("pc.governor", "ok", found, data={"governors": []})
    level: Level = "ok" if governors == ["performance"] else "warning"
    return DoctorFinding(
        "pc.governor",
        level,
        ", ".join(governors),
        "performance",
        "cpupower frequency-set -g performance",
        {"governors": governors},
    )


def check_sleep() -> DoctorFinding:
    """Check that the PC does not go to sleep during a run: the card would hold its voltage."""
    name = "pc.sleep"
    if not can_sleep():
        return DoctorFinding(name, "ok", "this PC cannot be suspended", data={"may_suspend": False})
    with keep_awake() as risk:
        data = {"may_suspend": bool(risk)}
    if not risk:
        return DoctorFinding(name, "ok", "may be suspended, but not during a run", data=data)
    return DoctorFinding(name, "warning", risk.partition(";")[0], "no sleep in a run", MASK, data)


def check_shared_memory(directory: Path) -> DoctorFinding:
    """Check that shared memory has room for rings and locks."""
    name, wanted = "pc.shared_memory", f"writable, {_RING_BYTES // _MB} MB free for ring and locks"
    if not (directory.is_dir() and os.access(directory, os.W_OK)):
        fix = f"mount -t tmpfs -o mode=1777 tmpfs {directory}"
        return DoctorFinding(name, "fault", f"{directory} cannot be written", wanted, fix)
    free = _free_bytes(directory)
    return DoctorFinding(
        name,
        "ok" if free >= _RING_BYTES else "fault",
        f"{directory}: {free // _MB} MB free",
        wanted,
        f"remove what fills {directory} (ls -l {directory}); the next `pamctl run` recovers "
        "the ring of a run that died",
        {"free_bytes": free},
    )


def check_log_disk(directory: Path) -> DoctorFinding:
    """Check how long a log may become."""
    place = next(path for path in (directory, *directory.absolute().parents) if path.is_dir())
    if not os.access(place, os.W_OK):
        fix = "change to a directory that you may write, or give --log to each run"
        return DoctorFinding("pc.log_disk", "fault", f"{place} cannot be written", "writable", fix)
    free = _free_bytes(place)
    lasts_s = free / _LOG_BYTES_PER_S
    level: Level = (
        "fault"
        if lasts_s < _SHORTEST_LOG_S
        else "warning"
        if lasts_s < _COMFORTABLE_LOG_S
        else "ok"
    )
    return DoctorFinding(
        "pc.log_disk",
        level,
        f"{place}: {free // _MB} MB free, logs of {lasts_s / 3600:.1f} h",
        f"room for an hour ({_LOG_BYTES_PER_S * 3600 // _MB} MB)",
        "remove old logs, or log to another disk with --log",
        {"free_bytes": free, "log_s": lasts_s},
    )


def judge_permissions(preparation: Preparation) -> Iterator[DoctorFinding]:
    """Say which steps of the preparation for real time this user is permitted."""
    for step in preparation.steps:
        if step.name not in _RIGHTS:
            continue
        # A refusal worsens the timing, never the run. `--rt require` makes it an error.
        level: Level = "ok" if step.done else "warning"
        reason, _, fix = step.detail.partition("; ")
        yield DoctorFinding(
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
