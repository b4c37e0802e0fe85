"""The health of a rig as a report, and its last good state as a plant file."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from pamctl.report.axes import PlotAxis
from pamctl.report.figure import Plot
from pamctl.report.report import Figure, Report, ReportTable, Section, Text
from pamctl.settings.yaml12 import dump_yaml
from pamctl.watch.follow_health import MISFIT, FittedRun, FollowedDrift, RigHealth

SCHEMA = 1
AIR_NUMBERS = ("valve_gain_m2_per_v", "tank_pressure_pa", "braid_length_m")
"""Numbers of a pressure balance."""
AIR_RIVALS = ("chamber_leak", "valve_leak", "null_offset")
"""Effects that a pressure balance cannot tell from its numbers where each is small."""


def _describe_health(health: RigHealth) -> list[str]:
    """Return what is to be said, one sentence a drift."""
    lines = [describe_drift(drift, health.runs) for drift in health.drifts]
    if not lines:
        lines = [f"No number drifts over {len(health.runs)} runs."]
    if health.plant is None:
        lines.append("No run is explained by the plant file with any numbers: diagnose one.")
    return lines


def describe_drift(drift: FollowedDrift, runs: Sequence[FittedRun]) -> str:
    """Return one drift as a sentence."""
    change = drift.change
    at = format_day(runs[change.first].when_s), format_day(runs[change.second].when_s)
    size = f"from {change.before:.4g} to {change.after:.4g} {change.unit}".rstrip()
    if change.before and not change.name.endswith(MISFIT):
        size = f"{100.0 * change.relative:+.1f} % ({size})"
    rivals = list_rivals(drift)
    if rivals:
        size += f", or {', or '.join(rivals)} (the pressures of these runs cannot tell)"
    if change.kind == "step":
        names = f"{runs[change.first].name} and {runs[change.second].name}"
        text = f"{change.name}: {size}, a step between {names} ({at[1]})"
    else:
        text = f"{change.name}: {size}, a trend since {at[0]}"
    if change.name.endswith(MISFIT) and change.after > change.before:
        text += "; no number of the plant file explains it: `pamctl diagnose` the later run"
    elif drift.is_doubtful:
        text += "; doubtful, because a misfit changed too"
    elif rivals:
        text += "; `pamctl diagnose` the later run"
    return text + "."


def list_rivals(drift: FollowedDrift) -> tuple[str, ...]:
    """Return the effects that may have moved the number in its place."""
    return AIR_RIVALS if drift.change.name in AIR_NUMBERS else ()


def format_day(when_s: float) -> str:
    """Return a time for people, in UTC."""
    return datetime.fromtimestamp(when_s, UTC).strftime("%d %B %Y %H:%M")


def _build_document(health: RigHealth) -> dict[str, Any]:
    """Return the document as plain values."""
    return {
        "schema": SCHEMA,
        "sentences": _describe_health(health),
        "drifts": [_drift_entry(drift, health.runs) for drift in health.drifts],
        "runs": [
            {
                "log": run.name,
                "when_s": run.when_s,
                "experiment": run.experiment,
                "numbers": {name: n.as_dict() for name, n in run.numbers.items()},
            }
            for run in health.runs
        ],
        "refused": [{"log": run.name, "reason": run.refused} for run in health.refused],
        "last_good": [run.name for run in health.good],
    }


def _drift_entry(drift: FollowedDrift, runs: Sequence[FittedRun]) -> dict[str, Any]:
    change = drift.change
    return {
        "name": change.name,
        "kind": change.kind,
        "from": runs[change.first].name,
        "to": runs[change.second].name,
        "before": change.before,
        "after": change.after,
        "unit": change.unit,
        "sigmas": change.sigmas,
        "not_refuted": list_rivals(drift),
        "doubtful": drift.is_doubtful,
    }


def format_good_plant(health: RigHealth) -> str:
    """Write the last good state as a plant file; there must be one."""
    assert health.plant is not None
    data = health.plant.model_dump(mode="json", round_trip=True, exclude_none=True)
    names = ", ".join(run.name for run in health.good)
    return f"# Written by `pamctl health`: the last good state, from {names}.\n{dump_yaml(data)}"


DAY_S = 86400.0
_LONG_S = 2.0 * DAY_S
_SHORT_S = 60.0
"""Runs of less apart are placed by their order."""


def report_health(health: RigHealth, folder: str) -> Report:
    """Return what changed in the runs of a folder, with a picture of each number."""
    first, last = health.runs[0], health.runs[-1]
    span = f"{format_day(first.when_s)} to {format_day(last.when_s)}"
    verdict, *others = _describe_health(health)
    report = Report(
        f"Health of {folder}",
        verdict,
        "bad" if health.drifts else "good",
        f"{len(health.runs)} runs, {span}",
        document=_build_document(health),
    )
    report.add(*(Text(sentence, report.kind) for sentence in others), Section("Numbers"))
    names = dict.fromkeys(name for run in health.runs for name in run.numbers)
    report.add(
        Figure(
            [*(_draw_number(health, name) for name in names)],
            "A dot is a run; the band is its 90 % interval. Steps are marked.",
        )
    )
    if health.refused:
        report.add(
            Section("Logs left out"),
            ReportTable(["log", "why"], [[run.name, run.refused] for run in health.refused]),
        )
    return report


def _place_runs(runs: Sequence[FittedRun]) -> tuple[list[float], PlotAxis]:
    """Return the place of each run on the axis of all figures."""
    since_s = np.array([run.when_s - runs[0].when_s for run in runs])
    span_s = float(np.ptp(since_s))
    # Runs of one moment, as those without a clock and copied files have, stand side by side.
    if span_s < _SHORT_S:
        places, axis = np.arange(len(runs), dtype=np.float64), PlotAxis("run", "")
    elif span_s > _LONG_S:
        places, axis = since_s / DAY_S, PlotAxis("since the first run", "d")
    elif span_s < 2.0 * 3600.0:
        places, axis = since_s / 60.0, PlotAxis("since the first run", "min")
    else:
        places, axis = since_s / 3600.0, PlotAxis("since the first run", "h")
    return places.tolist(), axis


def _draw_number(health: RigHealth, name: str) -> Plot:
    places, axis = _place_runs(health.runs)
    having = [k for k, run in enumerate(health.runs) if name in run.numbers]
    x = [places[k] for k in having]
    numbers = [health.runs[k].numbers[name] for k in having]
    plot = Plot(name, axis, PlotAxis(name, numbers[0].unit))
    plot.band(x, [n.low for n in numbers], [n.high for n in numbers])
    plot.line(x, [n.value for n in numbers])
    plot.points(x, [n.value for n in numbers])
    for drift in health.drifts:
        change = drift.change
        if change.name == name and change.kind == "step":
            plot.place(places[change.second], "step")
    return plot
