"""The guardian: drives the safe voltage when the loop cannot.

A card holds its last voltage when the process that wrote it dies, and a PCI-6221 has no
watchdog. So a second process waits for the loop's death, which the kernel reports at once, and
watches the loop's heartbeat in the ring's header. A loop that is silent for too long is killed,
whatever the cause, because only its death releases the output. This includes a loop that is
stopped by a debugger or by SIGSTOP.

The guardian knows no backend: it asks a rig for `make_safe` only.

Is a silent loop frozen, or does it only get no CPU? A shared virtual machine takes a core away for
tens of milliseconds. The kernel's books tell the two apart: a starved process is runnable and its
time on the CPU stands still. One that computes for ever uses CPU time, one that waits for a driver
sleeps, and one that a signal has stopped is neither.
"""

from __future__ import annotations

import os
import select
import signal
import time
from pathlib import Path
from typing import NamedTuple

from hal.rig import Rig, RigError
from pamctl.realtime.clock import SleepWatch
from pamctl.recording.ring import LoopStage, Ring

POLL_MS = 5
"""Time between two looks at the heartbeat. A death wakes the guardian at once."""
_POLL_NS = POLL_MS * 1_000_000

SETTING_UP_NS = 60_000_000_000
LEAVING_NS = 5_000_000_000
"""Patience before the first tick and after the last, while the valve is safe: a driver may take
seconds, but not for ever."""

_DEATH_MS = 2_000
"""How long to wait for the end of a killed loop before trying the output anyway."""
_SAFE_PATIENCE_S = 10.0
_RETRY_S = 1e-3


class Takeover(NamedTuple):
    """Why the guardian took the output over, and with what result."""

    reason: str
    """Empty where the loop died: only its parent knows how."""
    silent_ms: float
    """From the loop's last heartbeat until the guardian noticed."""
    latency_ms: float
    """From noticing to the safe voltage, including the killing of a frozen loop."""
    failure: str
    """Why the safe voltage could not be driven; empty where it was."""

    def event(self) -> dict[str, object]:
        """Return the event for the log."""
        return {"event": "guardian_takeover", **self._asdict(), "reason": self.reason or "died"}


class Listener:
    """Measures how long the loop has been silent while the guardian was awake to notice.

    A shared virtual machine sometimes stands still for tens of milliseconds, loop and guardian
    alike; 60 ms have been seen. The process that wakes first must not take the other for dead.
    So at most two periods count between two looks: if the guardian itself is late, the loop may
    have had no processor either. Late looks still count a little, so that a guardian that is
    always late notices a silent loop in the end.
    """

    def __init__(self, now_ns: int, beat_ns: int) -> None:
        """Begin: the loop counts as alive now."""
        self._now_ns = now_ns
        self._beat_ns = beat_ns
        self._silent_ns = 0
        self.heard_ns = self._unheard_ns = 0
        """How long the heart has been heard to beat, until its last beat. For one beat no more
        counts than two periods, which is a period of the slowest loop: the rest is a pause."""

    def measure_silence_ns(self, now_ns: int, beat_ns: int) -> int:
        """Look at the heartbeat; return how long it has stood still."""
        counted_ns = min(now_ns - self._now_ns, 2 * _POLL_NS)
        self._unheard_ns += counted_ns
        if beat_ns == self._beat_ns:
            self._silent_ns += counted_ns
        else:
            self._silent_ns = min(max(0, now_ns - beat_ns), counted_ns)
            self.heard_ns += min(self._unheard_ns, 2 * _POLL_NS)
            self._unheard_ns = 0
        self._now_ns, self._beat_ns = now_ns, beat_ns
        return self._silent_ns


def patience_ns(stage: int, done: bool, heartbeat_ns: int) -> int:
    """Return how long a loop may be silent: `heartbeat_ns` only while it drives the valve."""
    if done or stage == LoopStage.LEAVING:
        return LEAVING_NS
    return heartbeat_ns if stage == LoopStage.TICKING else SETTING_UP_NS


class Silence:
    """Judges a loop's silence: how long it may last depends on what the loop is doing."""

    def __init__(
        self, ring: Ring, loop_pid: int, heartbeat_ns: int, starved_ns: int, lead_ns: int = 0
    ) -> None:
        """Begin to listen: the loop counts as alive now.

        A loop that ticks may be silent for `heartbeat_ns`; for `starved_ns`, if that is longer,
        where it gets no CPU. `lead_ns` is added to both.
        """
        self._ring = ring
        self._listener = Listener(time.monotonic_ns(), ring.loop_beat_ns)
        self._books = CpuBooks(loop_pid)
        self._is_counting = False
        self._sleep = SleepWatch()
        self._heard_asleep_ns: int | None = None
        self._heartbeat_ns, self._starved_ns, self._lead_ns = heartbeat_ns, starved_ns, lead_ns

    def find_fault(self) -> str:
        """Look at the heartbeat; say what is wrong with a loop that must be killed."""
        now_ns = time.monotonic_ns()
        fault = self._find_silence(now_ns)
        slept_ns = self._sleep.slept_ns()
        if slept_ns <= self._heartbeat_ns:
            return fault
        if not fault and self._goes_on():
            fault = "the loop went on"
        return f"{fault} after the PC had slept for {slept_ns * 1e-9:.1f} s" if fault else ""

    def _find_silence(self, now_ns: int) -> str:
        silent_ns = self._listener.measure_silence_ns(now_ns, self._ring.loop_beat_ns)
        self._count_cpu_time(now_ns, silent_ns)
        ring = self._ring
        patience = patience_ns(ring.loop_stage, bool(ring.loop_done), self._heartbeat_ns)
        if silent_ns <= patience + self._lead_ns:
            return ""
        silent_ms = silent_ns * 1e-6
        if not self._books.is_starved(now_ns):
            return f"the loop was silent for {silent_ms:.0f} ms"
        if silent_ns <= max(patience, self._starved_ns) + self._lead_ns:
            return ""
        return f"the loop was starved: it got no CPU for {silent_ms:.0f} ms"

    def _goes_on(self) -> bool:
        """Tell whether a loop still ticks, though it should have tripped: the PC has slept."""
        heard_ns = self._listener.heard_ns
        if self._heard_asleep_ns is None:
            self._heard_asleep_ns = heard_ns
        is_ticking = self._ring.loop_stage == LoopStage.TICKING and not self._ring.loop_done
        had_ns = self._heartbeat_ns + self._lead_ns
        return is_ticking and heard_ns - self._heard_asleep_ns > had_ns

    def _count_cpu_time(self, now_ns: int, silent_ns: int) -> None:
        is_suspicious = silent_ns > 2 * _POLL_NS
        if is_suspicious and not self._is_counting:
            self._books.open_account(now_ns)
        self._is_counting = is_suspicious


class LoopProcess:
    """A handle on the loop that cannot come to mean a later process of the same id."""

    def __init__(self, pid: int) -> None:
        """A `pid` that is gone is a loop that is dead."""
        self.pid = pid
        self._poll = select.poll()
        self._fd: int | None = None
        try:
            self._fd = os.pidfd_open(pid)
            self._poll.register(self._fd, select.POLLIN)
        except ProcessLookupError:
            pass

    def dies_within(self, timeout_ms: int) -> bool:
        """Wait for the loop's death; return whether it is dead."""
        return self._fd is None or bool(self._poll.poll(timeout_ms))

    def kill(self) -> None:
        """Kill the loop, frozen or not."""
        if self._fd is not None:
            signal.pidfd_send_signal(self._fd, signal.SIGKILL)


def guard(
    ring: Ring, loop: LoopProcess, rig: Rig, heartbeat_ns: int, starved_ns: int = 0
) -> Takeover | None:
    """Watch the loop to its end, and leave the rig at its safe voltage.

    Returns None after an orderly end.
    """
    silence = Silence(ring, loop.pid, heartbeat_ns, starved_ns)
    reason = ""
    while not loop.dies_within(POLL_MS):
        ring.guardian_beats += 1
        if fault := silence.find_fault():
            reason = f"{fault} and was killed"
            break
    noticed_ns = time.monotonic_ns()
    if reason:
        loop.kill()
        loop.dies_within(_DEATH_MS)
    return take_over(ring, rig, reason, noticed_ns)


def take_over(ring: Ring, rig: Rig, reason: str, noticed_ns: int) -> Takeover | None:
    """Drive the safe voltage for a loop that is dead; None where it had ended in good order."""
    failure = drive_safe(rig)
    if ring.loop_done and not failure:
        return None
    return Takeover(
        reason=reason,
        silent_ms=(noticed_ns - ring.loop_beat_ns) * 1e-6,
        latency_ms=(time.monotonic_ns() - noticed_ns) * 1e-6,
        failure=str(failure or ""),
    )


def drive_safe(rig: Rig, patience_s: float = _SAFE_PATIENCE_S) -> RigError | None:
    """Drive the safe voltage; return why it was not possible within the time.

    A driver may need a moment to notice that the owner of the output has died.
    """
    deadline_s = time.monotonic() + patience_s
    while True:
        rig.make_safe()
        failure = rig.safe_failure
        if failure is None or time.monotonic() >= deadline_s:
            return failure
        time.sleep(_RETRY_S)


_STARVED_SHARE = 0.5
"""A process that ran for less than this share of the time got no CPU to speak of."""


class CpuBooks:
    """What the kernel has written down about one process."""

    def __init__(self, pid: int) -> None:
        """Read the books of `pid`, which need not live any more."""
        self._pid = pid
        self._begin_ns = 0
        self._ran_ns: int | None = None

    def open_account(self, now_ns: int) -> None:
        """Count CPU time from now on."""
        self._begin_ns, self._ran_ns = now_ns, self._read_ran_ns()

    def is_starved(self, now_ns: int) -> bool:
        """Tell whether the process has wanted to run since `open_account`, and could not."""
        ran_ns = self._read_ran_ns()
        is_runnable = read_state(self._pid) == "R"
        if self._ran_ns is None or ran_ns is None or not is_runnable:
            return False
        return ran_ns - self._ran_ns < _STARVED_SHARE * (now_ns - self._begin_ns)

    def _read_ran_ns(self) -> int | None:
        try:
            return int(Path(f"/proc/{self._pid}/schedstat").read_text().split()[0])
        except (OSError, ValueError, IndexError):
            return None


def read_state(pid: int) -> str:
    """Return the kernel's letter for what a process is doing; empty if it is gone."""
    try:
        # The name in brackets may hold spaces and brackets.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return ""
