"""What happened in a run: marks, changes of gains, the trip, and the last seconds before it."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pamctl.log.run_meta import flight_record_path
from pamctl.new_file import write_files

if TYPE_CHECKING:
    from pamctl.log.reader import Log

CHANGES = "controller_changes"
"""Key beside `controller`, the name of the file: what differs from it; missing if nothing does."""
BESIDE_GAINS = ("event", "tick", "t_ns", "row", "from_t_s", "ramp_s")
"""What a message of gains holds besides: when they changed, and how fast."""
FLIGHT_RECORD_S = 2.0

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
        (min(int(ticks.searchsorted(event["tick"])), len(ticks) - 1), text)
        for event, text in named
        if isinstance(event.get("tick"), int)
    ]
    return sorted(Moment(float(t_s[row]), text) for row, text in rows)


def describe_changes(gains: Mapping[str, Any], of_file: Mapping[str, Any]) -> str:
    """Say which gains differ from the file's: `lambda_per_s 60 (file 37.82)`; empty if none do."""
    return ", ".join(
        f"{name} {_spell(gains[name])} (file {_spell(of_file.get(name, 'none'))})"
        for name in gains
        if gains[name] != of_file.get(name)
    )


def spell_controller(named: Mapping[str, Any]) -> str:
    """Return the controller's name, with a star and the changes where gains were changed."""
    name, changes = str(named.get("controller") or ""), named.get(CHANGES)
    return f"{name}*, {changes}" if changes else name


def list_gain_changes(
    gains: Sequence[Mapping[str, Any]],
) -> list[tuple[Mapping[str, Any], Mapping[str, Any], str]]:
    """Return the messages before and after each change, with the name of the gain that changed."""
    return [
        (before, after, name)
        for before, after in pairwise(gains)
        for name in after
        if name not in BESIDE_GAINS and after[name] != before.get(name)
    ]


def describe_running_changes(gains: Sequence[Mapping[str, Any]]) -> str | None:
    """Say how gains changed while the law ran: `lambda_per_s 37.82 to 60`; None if none did."""
    names = dict.fromkeys(name for *_, name in list_gain_changes(gains))
    said = (
        f"{name} {_spell(gains[0].get(name))} to {_spell(gains[-1].get(name))}" for name in names
    )
    return ", ".join(said) or None


def _spell(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def dump_last_seconds(log: Log) -> Path:
    """Write the last two seconds of a log beside it as CSV; return its path.

    Raise NewFileError if that fails.
    """
    path = flight_record_path(log.path)
    first = int(log.t[:].searchsorted(log.t[-1] - FLIGHT_RECORD_S))
    text = StringIO()
    table = csv.writer(text)
    table.writerow(log.columns)
    table.writerows(zip(*(log[name][first:].tolist() for name in log.columns), strict=True))
    write_files({path: text.getvalue()}, replaces="")
    return path
