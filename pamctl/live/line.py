"""State and newest ticks as one line of JSON, for the page and for `pamctl watch --json`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from pamctl.live.feed import Glimpse

LOOKS_PER_S = 10.0
EVERY = 20
"""Every twentieth tick is plotted: 50 points a second."""
COLUMNS = ("tick", "t_s", "phase", "position_m", "reference_m", "pressure_pa", "valve_v")
_STATUS_FIELDS = (
    "state", "fault", "run", "log", "worst_late_s", "missed_ticks", "backend", "device",
    "limits", "controller", "names", "gain_changes", "disk_free_bytes", "version", "events",
    "monitor",
)  # fmt: skip


def encode_glimpse(glimpse: Glimpse) -> str:
    """Return what was seen in one look as one line."""
    document = describe_glimpses([glimpse], glimpse)
    return json.dumps(document, separators=(",", ":"), allow_nan=False)


def describe_glimpses(glimpses: Sequence[Glimpse], newest: Glimpse | None) -> dict[str, Any]:
    """Return the ticks of several looks, and the state of the newest."""
    newest = newest or Glimpse(None, [])
    status: dict[str, Any] | None = None
    if newest.status is not None:
        status = {name: newest.status.get(name) for name in _STATUS_FIELDS}
    rows = [
        [_nan_to_none(tick[name]) for name in COLUMNS] for one in glimpses for tick in one.ticks
    ]
    return {"status": status, "problem": newest.problem, "fields": COLUMNS, "ticks": rows}


def _nan_to_none(value: float) -> float | None:
    return None if math.isnan(value) else value
