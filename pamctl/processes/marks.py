"""Marks for a run without a daemon: `pamctl mark TEXT` in a second terminal reaches its loop.

The text goes through the slot for orders in the run's ring, which only this user can open. It
stands in the log at the tick in which the loop took it.
"""

from __future__ import annotations

import time
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

from pamctl.base.errors import ExitCode
from pamctl.base.texts import LONGEST_REMARK, clean_text
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.realtime.orders import OrderError, Orders
from pamctl.recording.ring import LoopStage, Ring, RingError

_PATIENCE_S = 15.0
"""A loop that is just starting, on a busy PC, takes its first mark after some seconds."""
_POLL_S = 5e-3


class MarkError(Exception):
    """A mark could not be put. The message says why."""

    exit_code = ExitCode.CHECK_FAILED


class RunningRun(NamedTuple):
    """A run of this user that takes marks."""

    ring: Path
    log: Path


def list_running_runs() -> list[RunningRun]:
    """Return the runs that this user may mark."""
    found = []
    for path in sorted(SHARED_MEMORY.glob("pamctl-*.ring")):
        with suppress(RingError), Ring.attach(path, populate=False) as ring:
            if ring.slot_bytes and _takes_orders(ring) and not ring.claim():
                found.append(RunningRun(path, Path(ring.meta.log_path)))
    return found


def mark_run(run: RunningRun, text: str) -> None:
    """Put a mark into the log of a run; return when the loop has taken it. Raise MarkError."""
    text = clean_text(text)
    if not 1 <= len(text) <= LONGEST_REMARK:
        raise MarkError(f"a mark has 1 to {LONGEST_REMARK} characters")
    try:
        with Ring.attach(run.ring, populate=False) as ring, closing(Orders(ring.slot)) as orders:
            _await_slot(ring)
            orders.give({"do": "mark", "text": text}, _PATIENCE_S, lambda: _takes_orders(ring))
    except (RingError, OrderError) as error:
        raise MarkError(f"the run of {run.log} takes no mark: {error}") from error


def _takes_orders(ring: Ring) -> bool:
    return not ring.loop_done and ring.loop_stage != LoopStage.LEAVING


def _await_slot(ring: Ring) -> None:
    """Wait for others who are putting a mark."""
    deadline_s = time.monotonic() + _PATIENCE_S
    while not ring.claim_slot():
        if time.monotonic() > deadline_s:
            raise OrderError(f"another mark has waited for more than {_PATIENCE_S:g} s")
        time.sleep(_POLL_S)
