"""The ring of a run that goes on, seen from outside."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from pamctl.processes.backends import SHARED_MEMORY
from pamctl.recording.ring import Ring
from pamctl.signals import Phase
from support.patience import PATIENCE_S, await_true


def ring_left(front: int) -> Path | None:
    """Return the ring of the run whose front has this process id, while it has one."""
    return next(SHARED_MEMORY.glob(f"pamctl-{front}-*.ring"), None)


def await_ring(front: int) -> Path:
    return cast(Path, await_true(lambda: ring_left(front), "the front made no ring"))


def age_ring(path: Path) -> None:
    """Make a dead loop's last sign of life old; a young one might be of a run that just starts."""
    with Ring.attach(path) as ring:
        ring.loop_beat_ns = 1


def await_tick(front: int, holds: Callable[[dict[str, Any]], bool]) -> None:
    """Return once the newest tick is one for which `holds` is true."""
    deadline_s = time.monotonic() + PATIENCE_S
    with Ring.attach(await_ring(front)) as ring:
        while (tick := ring.latest_tick()) is None or not holds(tick):
            assert time.monotonic() < deadline_s, f"still waiting at {tick}"
            time.sleep(0.02)


def await_phase(front: int, phase: Phase) -> None:
    await_tick(front, lambda tick: tick["phase"] == phase)
