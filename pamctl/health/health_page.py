"""The page of a rig's health: one picture a number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pamctl.health.fit_run import FittedRun
from pamctl.health.follow_health import RigHealth
from pamctl.health.health_words import describe_health, format_day
from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page

DAY_S = 86400.0
_LONG_S = 2.0 * DAY_S


def write_health_page(health: RigHealth, folder: str) -> Page:
    """Return the page."""
    first, last = health.runs[0], health.runs[-1]
    span = f"{format_day(first.when_s)} to {format_day(last.when_s)}"
    page = Page(f"Health of {folder}", f"{len(health.runs)} runs, {span}")
    page.section("What changed")
    kind = "bad" if health.drifts else "good"
    for sentence in describe_health(health):
        page.note(sentence, kind=kind)
    page.section("Numbers")
    names = dict.fromkeys(name for run in health.runs for name in run.numbers)
    page.figure(
        *(_draw_number(health, name) for name in names),
        caption="A dot is a run; the band is its 90 % interval. Steps are marked.",
    )
    if health.refused:
        page.section("Logs left out")
        page.table(["log", "why"], [[run.name, run.refused] for run in health.refused])
    return page


def _place_runs(runs: Sequence[FittedRun]) -> tuple[list[float], PlotAxis]:
    """Return the place of each run on the axis of all figures."""
    since_s = np.array([run.when_s - runs[0].when_s for run in runs])
    span_s = float(np.ptp(since_s))
    # Runs of one moment, as those without a clock have, stand side by side.
    if span_s <= 0.0:
        places, axis = np.arange(len(runs), dtype=np.float64), PlotAxis("run", "")
    elif span_s > _LONG_S:
        places, axis = since_s / DAY_S, PlotAxis("since the first run", "d")
    else:
        places, axis = since_s / 3600.0, PlotAxis("since the first run", "h")
    return places.tolist(), axis


def _draw_number(health: RigHealth, name: str) -> SvgPlot:
    places, axis = _place_runs(health.runs)
    having = [k for k, run in enumerate(health.runs) if name in run.numbers]
    x = [places[k] for k in having]
    numbers = [health.runs[k].numbers[name] for k in having]
    plot = SvgPlot(name, axis, PlotAxis(name, numbers[0].unit))
    plot.band(x, [n.low for n in numbers], [n.high for n in numbers])
    plot.line(x, [n.value for n in numbers])
    plot.points(x, [n.value for n in numbers])
    for drift in health.drifts:
        change = drift.change
        if change.name == name and change.kind == "step":
            plot.place(places[change.second], "step")
    return plot
