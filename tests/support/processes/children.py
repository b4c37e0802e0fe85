"""The processes that a run's front starts, found by their command lines."""

from __future__ import annotations

import time
from pathlib import Path

from support.patience import PATIENCE_S

PARTS = ("loop_main", "guardian_main", "recorder")


def await_children(front: int, *names: str) -> dict[str, int]:
    """Wait until a front has a child for each of the modules named; return their process ids."""
    deadline_s = time.monotonic() + PATIENCE_S
    found: dict[str, int] = {}
    while len(found) < len(names):
        assert time.monotonic() < deadline_s, f"of {names} the front started only {found}"
        time.sleep(0.02)
        for pid in Path(f"/proc/{front}/task/{front}/children").read_text().split():
            command = Path(f"/proc/{pid}/cmdline").read_text()
            found |= {name: int(pid) for name in names if f".{name}\0" in command}
    return found


def await_gone(*pids: int) -> None:
    """Wait until none of the processes is left."""
    deadline_s = time.monotonic() + PATIENCE_S
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        assert time.monotonic() < deadline_s, "a process was left behind"
        time.sleep(0.02)
