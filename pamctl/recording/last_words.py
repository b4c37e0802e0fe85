"""Events that another process writes into the log for a dead loop."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

from pamctl.exit_codes import Ending
from pamctl.recording.ring import Ring, RingFull


def make_outcome_event(ending: Ending) -> dict[str, object]:
    """Return the event that ends every run."""
    return {"event": "outcome", "code": int(ending.code), "reason": ending.reason}


def put_last_event(ring: Ring, event: Mapping[str, object]) -> None:
    """Put an event at the time of the last tick; raise `RingFull` if there is no room."""
    last = ring.latest_tick() or {"tick": 0, "encoder_t_ns": ring.meta.start_mono_ns}
    ring.put_event(int(last["tick"]), int(last["encoder_t_ns"]), event)


def put_event_for_dead_loop(ring: Ring, event: Mapping[str, object]) -> None:
    """Put an event for a dead loop; a ring must have only one producer at a time."""
    ring.take_over()
    # The exit code matters more than the last event of the log.
    with suppress(RingFull):
        put_last_event(ring, event)
