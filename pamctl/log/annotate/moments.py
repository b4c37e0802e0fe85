"""The moments of a run that every plot over time marks: marks, changes of gains, the trip."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pamctl.log.changed_gains import list_gain_changes
from pamctl.log.reader import Log

_NAMES = {"mark": "mark", "tripped": "trip"}


class Moment(NamedTuple):
    """Something that happened in a run."""

    t_s: float
    """On the time axis of the run's ticks."""
    text: str


def list_moments(log: Log) -> list[Moment]:
    """Return marks, changes of gains and the trip in order; those without a tick are left out."""
    ticks, t_s = log.columns.get("tick"), log.columns.get("t_s")
    if ticks is None or t_s is None or not len(ticks):
        return []
    named: list[tuple[Mapping[str, Any], str]] = [
        (event, str(event.get("text", _NAMES[event["event"]])))
        for event in log.events
        if event.get("event") in _NAMES
    ]
    changed = {id(after): after for _, after, _ in list_gain_changes(log.gains)}
    named += [(after, "gains") for after in changed.values()]
    rows = [
        (min(int(np.searchsorted(ticks, event["tick"])), len(ticks) - 1), text)
        for event, text in named
        if isinstance(event.get("tick"), int)
    ]
    return sorted(Moment(float(t_s[row]), text) for row, text in rows)
