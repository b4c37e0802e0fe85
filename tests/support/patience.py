"""How patient tests are: the machine that runs them may be busy with other work.

No test says how soon something happens, only that it happens. Benchmarks measure times.
"""

import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE_S = 60.0
"""How long a test waits for what must happen (s)."""

BUSY_PC = [
    "rig.limits.sample_age_s=60",
    "rig.limits.missed_ticks=1e6",
    "rig.limits.pressure_model_pa=2e6",
    "rig.limits.tracking_error_mm=1e3",
    "rig.loop.heartbeat_ms=1000",
]
"""Settings of a run in real time: a late tick neither trips the run nor kills the loop."""

Found = TypeVar("Found")


def await_true(
    find: Callable[[], Found], why: str = "it does not happen", every_s: float = 0.02
) -> Found:
    """Return what `find` finds, as soon as it is true; `why` is told if it never is."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not (found := find()):
        assert time.monotonic() < deadline_s, why
        time.sleep(every_s)
    return found
