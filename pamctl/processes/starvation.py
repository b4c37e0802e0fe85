"""Is a silent loop frozen, or does it only get no CPU?

A shared virtual machine takes a core away for tens of milliseconds. Then the loop is ready to
run and does nothing wrong. The kernel's books tell the two apart: a starved process is runnable
and its time on the CPU stands still. One that computes for ever uses CPU time, one that waits
for a driver sleeps, and one that a signal has stopped is neither.
"""

from __future__ import annotations

from pathlib import Path

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
