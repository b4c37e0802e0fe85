"""The result of a sweep: figures of merit against its settings, as a table and as a page."""

from __future__ import annotations

import csv
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pamctl.json_text import to_json
from pamctl.report.figure import COLOURS, Plot, PlotAxis
from pamctl.report.report import Figure, Report, ReportTable, Section, Text
from pamctl.runs.run_row import METRICS, RunRow, SettingValue, is_number, read_value


class MetricSpread(NamedTuple):
    """A metric over repeats, in um."""

    mean: float
    sd: float | None
    """Standard deviation of one run; None for a single one."""
    low: float
    high: float


class SweepPoint(NamedTuple):
    """The runs of one combination."""

    point: Mapping[str, Any]
    runs: int
    """Those that ended well."""
    failed: Mapping[str, int]
    """The others, by how they ended."""
    metrics: Mapping[str, MetricSpread]
    """By name; a metric that no run has is missing."""


def summarise_points(rows: Sequence[RunRow]) -> list[SweepPoint]:
    """Return the points in the order of their first run."""
    groups: dict[str, list[RunRow]] = {}
    for row in rows:
        groups.setdefault(to_json(row.sweep["point"]).decode(), []).append(row)
    return [_summarise(group) for group in groups.values()]


def _summarise(rows: Sequence[RunRow]) -> SweepPoint:
    well = [row for row in rows if row.ending == "ok"]
    others = [row.ending for row in rows if row.ending != "ok"]
    metrics = {}
    for name in METRICS:
        values = [value for row in well if (value := getattr(row, name)) is not None]
        if values:
            sd = statistics.stdev(values) if len(values) > 1 else None
            metrics[name] = MetricSpread(statistics.fmean(values), sd, min(values), max(values))
    failed = {ending: others.count(ending) for ending in dict.fromkeys(others)}
    return SweepPoint(rows[0].sweep["point"], len(well), failed, metrics)


def tabulate_points(points: Sequence[SweepPoint]) -> ReportTable:
    """Return a table: mean and standard deviation of each metric that any point has."""
    keys = list(points[0].point)
    heads = dict(zip(METRICS, ("max, µm", "RMS, µm", "steady, µm"), strict=True))
    known = [name for name in METRICS if any(name in one.metrics for one in points)]
    rows = []
    for one in points:
        failed = "".join(f", {count} {ending}" for ending, count in one.failed.items())
        metrics = [_format_spread(one.metrics.get(name)) for name in known]
        rows.append([*(str(one.point[key]) for key in keys), f"{one.runs}{failed}", *metrics])
    return ReportTable([*keys, "runs", *(heads[name] for name in known)], rows)


def _format_spread(spread: MetricSpread | None) -> str:
    if spread is None:
        return "-"
    return f"{spread.mean:.1f}" + ("" if spread.sd is None else f" ± {spread.sd:.1f}")


def format_points_csv(points: Sequence[SweepPoint]) -> str:
    """Return a line for each point."""
    keys = list(points[0].point) if points else []
    text = StringIO()
    table = csv.writer(text, lineterminator="\n")
    parts = [f"{name}_{part}" for name in METRICS for part in MetricSpread._fields]
    table.writerow([*keys, "runs", "failed", *parts])
    for one in points:
        spreads = (one.metrics.get(name) or [""] * len(MetricSpread._fields) for name in METRICS)
        figures = [value for spread in spreads for value in spread]
        failed = sum(one.failed.values())
        table.writerow([*(one.point[key] for key in keys), one.runs, failed, *figures])
    return text.getvalue()


def list_point_documents(points: Sequence[SweepPoint]) -> list[dict[str, Any]]:
    """Return the points as plain values."""
    return [
        {**one._asdict(), "metrics": {n: spread._asdict() for n, spread in one.metrics.items()}}
        for one in points
    ]


_MOST_ROWS = 500
_LOG_RATIO = 20.0
"""An axis is logarithmic from this ratio of its values on."""


def write_sweep_page(
    name: str, folder: Path, rows: Sequence[RunRow], keys: Sequence[str]
) -> Report:
    """Return the page of a sweep's runs, with a section for each of the swept `keys`."""
    page = Report(f"Sweep {name}", subtitle=f"{len(rows)} runs of {folder}")
    page.add(tabulate_points(summarise_points(rows)))
    for key in keys:
        page.add(Section(key))
        others = [other for other in keys if other != key] if len(keys) <= 2 else []
        draw_metrics(page, rows, key, others)
    if not keys:
        page.add(Text("No setting that is a number differs between these runs."))
    _write_table(page, rows, keys)
    return page


def draw_metrics(
    page: Report, rows: Sequence[RunRow], key: str, others: Sequence[str] = ()
) -> None:
    """Write a figure of each metric against a setting; runs of equal `others` share a colour."""
    placed = [row for row in rows if is_number(read_value(row, key))]
    plots = [
        plot
        for metric, name in METRICS.items()
        if (plot := _draw_metric(placed, key, metric, name, others)) is not None
    ]
    if not plots:
        page.add(Text("None of these runs tracked anything."))
        return
    spread = "A dot is a run; the line joins the means, the band spans repeats."
    lost = sum(1 for row in placed if row.ending not in ("ok", "imported"))
    page.add(Figure([*plots], spread + (f" Left out: {lost} that did not end well." * bool(lost))))


def _draw_metric(
    rows: Sequence[RunRow], key: str, metric: str, name: str, others: Sequence[str]
) -> Plot | None:
    groups = group_metric(rows, key, metric, others)
    places = [x for points in groups.values() for x in points]
    if not places:
        return None
    x_axis = PlotAxis(key, "", log=min(places) > 0 and max(places) / min(places) >= _LOG_RATIO)
    plot = Plot(name[:1].upper() + name[1:], x_axis, PlotAxis(name, "µm"))
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


def _write_table(page: Report, rows: Sequence[RunRow], keys: Sequence[str]) -> None:
    page.add(Section("Runs"))
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
    table = ReportTable(list(columns), list(zip(*columns.values(), strict=True)))
    page.add(table.drop_empty())
    if len(shown) < len(rows):
        page.add(Text(f"{len(rows) - len(shown)} older runs are in the figures, not in the table."))


def _or_dash(value: SettingValue) -> SettingValue:
    return "-" if value is None else value


def _format_um(row: RunRow, metric: str) -> str:
    value = getattr(row, metric)
    return "-" if value is None else f"{value:.1f}"
