"""The processes that a run's front starts, found by their command lines."""

from __future__ import annotations

from pathlib import Path

from support.patience import await_true

PARTS = ("loop_main", "guardian_main", "recorder")


def await_children(front: int, *names: str) -> dict[str, int]:
    """Wait until a front has a child for each of the modules named; return their process ids."""
    found: dict[str, int] = {}

    def find_all() -> bool:
        for pid in list_children(front):
            command = Path(f"/proc/{pid}/cmdline").read_text()
            found.update({name: pid for name in names if f".{name}\0" in command})
        return len(found) == len(names)

    await_true(find_all, f"the front did not start all of {names}")
    return found


def list_children(pid: int) -> list[int]:
    """Return the processes that any thread of a process has started."""
    lists = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return [int(child) for text in lists for child in text.split()]


def await_gone(*pids: int) -> None:
    """Wait until none of the processes is left."""
    left = [Path(f"/proc/{pid}") for pid in pids]
    await_true(lambda: not any(map(Path.exists, left)), "a process was left behind")
