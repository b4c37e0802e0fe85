"""Events and settings of the runs: safety, gains, versions, configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import yaml

from pamctl.json_text import to_json
from pamctl.log.moments import list_gain_changes
from pamctl.plain_text import clean_text
from pamctl.report.html_page import Page
from pamctl.report.reported_run import ReportedRun
from pamctl.safety import VERDICTS

MOST_EVENTS = 200
_WHERE = ("event", "tick", "t_ns", "row")


def write_safety(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write every clip and trip with its reason and time."""
    page.section("Safety")
    for run in runs:
        if len(runs) > 1:
            page.heading(run.name)
        verdicts = run.log.columns.get("verdicts")
        if verdicts is None:
            page.text("The log was made without these safety rules: clips are unknown.")
            continue
        rows = [
            ["clip" if bit < 1 << 8 else "trip", meaning, str(len(at)), *_show_span(run, at)]
            for bit, meaning in VERDICTS.items()
            if len(at := np.flatnonzero(np.asarray(verdicts, np.int64) & bit))
        ]
        if rows:
            page.table(["", "reason", "ticks", "first, s", "last, s"], rows)
        else:
            page.text("Safety clipped no command and did not trip.")


def _show_span(run: ReportedRun, at: np.ndarray) -> tuple[str, str]:
    return f"{run.t_s[at[0]]:.3f}", f"{run.t_s[at[-1]]:.3f}"


def write_events(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write the events in order."""
    page.section("Events")
    for run in runs:
        if len(runs) > 1:
            page.heading(run.name)
        events = run.log.events
        if not events:
            page.text("The log has no events.")
            continue
        rows = [[_show_time(run, e), str(e.get("event", "")), _show_details(e)] for e in events]
        page.table(["at, s", "event", "details"], rows[:MOST_EVENTS])
        if len(rows) > MOST_EVENTS:
            page.text(f"{len(rows) - MOST_EVENTS} more events are in the log.")
        _write_gain_changes(page, run)


def _write_gain_changes(page: Page, run: ReportedRun) -> None:
    """Write the gains that changed while the law ran; the first are in the configuration."""
    rows = [
        [
            _show_time(run, after),
            name,
            _show_short(before.get(name, "-")),
            _show_short(after[name]),
            _show_short(after.get("ramp_s", "-")),
        ]
        for before, after, name in list_gain_changes(run.log.gains)
    ]
    if rows:
        header = ["at, s", "gain", "from", "to", "within, s"]
        page.table(header, rows[:MOST_EVENTS], caption="Changed gains.")


def _show_time(run: ReportedRun, event: Mapping[str, Any]) -> str:
    at_s = run.time_of(event)
    return "-" if at_s is None else f"{at_s:.3f}"


def _show_details(event: Mapping[str, Any]) -> str:
    parts = ((name, value) for name, value in event.items() if name not in _WHERE)
    return ", ".join(f"{name} {_show_short(value)}" for name, value in parts)


def _show_short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return clean_text(value) if isinstance(value, str) else to_json(value).decode()


def write_differences(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write a table of the settings that differ between the runs."""
    page.section("What differs")
    settings = [dict(_flatten_settings(run.log.config)) for run in runs]
    keys = dict.fromkeys(key for setting in settings for key in setting)
    rows = [
        [key, *(_show_short(setting.get(key, "-")) for setting in settings)]
        for key in keys
        if len({_show_short(setting.get(key, "-")) for setting in settings}) > 1
    ]
    if rows:
        page.table(["setting", *(run.name for run in runs)], rows)
    else:
        page.text("The runs have the same settings.")


def _flatten_settings(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten_settings(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def write_settings(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write versions, rig and resolved configuration, folded."""
    page.section("Configuration")
    for run in runs:
        whose = f" of {run.name}" if len(runs) > 1 else ""
        for name, title in (
            ("pamctl", "Versions"),
            ("timing_setup", "Real-time measures"),
            ("rig", "The rig's own description"),
            ("import", "Import"),
        ):
            if name in run.log.metadata:
                page.fold(f"{title}{whose}", _format_yaml(dict(run.log.metadata[name])))
        if run.log.config:
            page.fold(f"Resolved configuration{whose}", _format_yaml(run.log.config))
        else:
            page.text(f"The log{whose} carries no configuration.")


def _format_yaml(value: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(value), sort_keys=False, allow_unicode=True).rstrip()
