"""The page of a sweep: figures of merit against the swept settings, with the spread of repeats."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from pamctl.report.drawing.svg import COLOURS, PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.runs.run_row import METRICS, RunRow, SettingValue, is_number, read_value

_MOST_ROWS = 500
_LOG_RATIO = 20.0
"""An axis is logarithmic from this ratio of its values on."""


def write_sweep_page(name: str, folder: Path, rows: Sequence[RunRow], keys: Sequence[str]) -> Page:
    """Return the page of a sweep's runs, with a section for each of the swept `keys`."""
    page = Page(f"Sweep {name}", f"{len(rows)} runs of {folder}")
    for key in keys:
        page.section(key)
        others = [other for other in keys if other != key] if len(keys) <= 2 else []
        draw_metrics(page, rows, key, others)
    if not keys:
        page.text("No setting that is a number differs between these runs.")
    _write_table(page, rows, keys)
    return page


def draw_metrics(page: Page, rows: Sequence[RunRow], key: str, others: Sequence[str] = ()) -> None:
    """Write a figure of each metric against a setting; runs of equal `others` share a colour."""
    placed = [row for row in rows if is_number(read_value(row, key))]
    plots = [
        plot
        for metric, name in METRICS.items()
        if (plot := _draw_metric(placed, key, metric, name, others)) is not None
    ]
    if not plots:
        page.text("None of these runs tracked anything.")
        return
    spread = "A dot is a run; the line joins the means, the band spans repeats."
    lost = sum(1 for row in placed if row.ending not in ("ok", "imported"))
    page.figure(*plots, caption=spread + (f" Left out: {lost} that did not end well." * bool(lost)))


def _draw_metric(
    rows: Sequence[RunRow], key: str, metric: str, name: str, others: Sequence[str]
) -> SvgPlot | None:
    groups = group_metric(rows, key, metric, others)
    places = [x for points in groups.values() for x in points]
    if not places:
        return None
    x_axis = PlotAxis(key, "", log=min(places) > 0 and max(places) / min(places) >= _LOG_RATIO)
    plot = SvgPlot(name[:1].upper() + name[1:], x_axis, PlotAxis(name, "µm"))
    named = len(groups) > 1 and len(groups) <= COLOURS
    for colour, (group, points) in enumerate(sorted(groups.items(), key=str)):
        x = np.array(sorted(points))
        values = [np.array(points[place]) for place in x.tolist()]
        label = ", ".join(f"{_shorten(k)} {v}" for k, v in group) if named else ""
        if named or len(groups) == 1:
            if any(len(repeats) > 1 for repeats in values):
                low, high = [v.min() for v in values], [v.max() for v in values]
                plot.band(x, low, high, colour=colour)
            plot.line(x, [v.mean() for v in values], label, colour=colour)
        pairs = np.array(
            [pair for at, v in zip(x, values, strict=True) for pair in product([at], v)]
        )
        plot.points(pairs[:, 0], pairs[:, 1], colour=colour if named else 0)
    return plot


def group_metric(
    rows: Sequence[RunRow], key: str, metric: str, others: Sequence[str] = ()
) -> dict[tuple[tuple[str, SettingValue], ...], dict[float, list[float]]]:
    """Return the metric of the runs that ended well, by the values of `others` and of the key."""
    groups: dict[tuple[tuple[str, SettingValue], ...], dict[float, list[float]]] = {}
    for row in rows:
        value, at = getattr(row, metric), read_value(row, key)
        if value is None or not is_number(at) or row.ending not in ("ok", "imported"):
            continue
        group = tuple((other, read_value(row, other)) for other in others)
        points = groups.setdefault(group, defaultdict(list))
        points[float(at)].append(value)  # type: ignore[arg-type]
    return groups


def _shorten(key: str) -> str:
    return key.rpartition(".")[2]


def _write_table(page: Page, rows: Sequence[RunRow], keys: Sequence[str]) -> None:
    page.section("Runs")
    shown = rows[-_MOST_ROWS:]
    columns = {
        **{key: [str(_or_dash(read_value(row, key))) for row in shown] for key in keys},
        "ending": [row.ending for row in shown],
        **{
            f"{name}, µm": [_format_um(row, metric) for row in shown]
            for metric, name in METRICS.items()
        },
        "tags": [" ".join(row.tags) for row in shown],
        "note": [row.note for row in shown],
        "log": [row.path for row in shown],
    }
    said = {
        head: cells for head, cells in columns.items() if any(c not in ("", "-") for c in cells)
    }
    page.table(list(said), list(zip(*said.values(), strict=True)))
    if len(shown) < len(rows):
        page.text(f"{len(rows) - len(shown)} older runs are in the figures, not in the table.")


def _or_dash(value: SettingValue) -> SettingValue:
    return "-" if value is None else value


def _format_um(row: RunRow, metric: str) -> str:
    value = getattr(row, metric)
    return "-" if value is None else f"{value:.1f}"
