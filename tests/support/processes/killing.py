"""Killing a run as a whole: none of its processes lives to see another one go."""

from __future__ import annotations

import os
import signal


def kill_as_one(front: int, *parts: int) -> None:
    """Kill a front and the processes that it started.

    The front last: when it dies, the kernel wakes those of its children that are stopped, each
    being a process group that is orphaned now.
    """
    for number in (signal.SIGSTOP, signal.SIGKILL):
        for pid in (*parts, front):
            os.kill(pid, number)
