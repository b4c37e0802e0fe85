"""The newest ticks as columns of JSON, for clients that plot them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pamctl.daemon.protocol import RequestRefusedError
from pamctl.daemon.session import Session
from pamctl.signals import TICK_FIELDS

_MOST_VALUES = 5000
"""Values in one answer: writing more would keep the next client waiting."""


def read_recent_columns(
    session: Session | None, after_tick: int, every: int, fields: Sequence[str] | None
) -> dict[str, Any]:
    """Return columns of the ticks after `after_tick` whose number `every` divides.

    Oldest first; the newest five thousand values at most, which is 1.3 s of all columns at
    100 Hz. Numbers that are not finite are null. Raises `RequestRefusedError` for an unknown
    column.
    """
    names = [field.name for field in TICK_FIELDS]
    unknown = set(fields or ()) - set(names)
    if unknown:
        raise RequestRefusedError(f"no column {', '.join(sorted(unknown))}")
    chosen = list(fields or names)
    most = _MOST_VALUES // len(chosen)
    ticks = [] if session is None else session.recent_ticks(after_tick, every, most)
    return {
        "fields": chosen,
        "ticks": [[_nan_to_none(tick[name]) for name in chosen] for tick in ticks],
    }


def replace_nan(tick: Mapping[str, float]) -> dict[str, float | None]:
    """Return a tick for JSON, which has no NaN: unknown values are null."""
    return {name: _nan_to_none(value) for name, value in tick.items()}


def _nan_to_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
