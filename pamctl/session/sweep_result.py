"""The result of a sweep: figures of merit against its settings, as a table and as a page."""

from __future__ import annotations

import csv
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.json_text import to_json
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import COLOURS, Plot
from pamctl.report.report import Figure, Report, ReportTable, Section, Text
from pamctl.runs.run_row import METRICS, RunRow, is_number, read_value


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
    points = summarise_points(rows)
    page.add(tabulate_points(points))
    for key in keys:
        page.add(Section(key))
        drawn = [_draw_metric(points, key, metric, keys) for metric in METRICS]
        plots = [plot for plot in drawn if plot is not None]
        if not plots:
            page.add(Text("None of these runs tracked anything."))
            continue
        page.add(Figure([*plots], "A dot is a point's mean over its repeats; the band spans them."))
    if not keys:
        page.add(Text("No setting that is a number differs between these runs."))
    _write_table(page, rows, keys)
    return page


def _draw_metric(
    points: Sequence[SweepPoint], key: str, metric: str, keys: Sequence[str]
) -> Plot | None:
    """Draw a metric against a setting; points whose other setting is equal share a colour."""
    others = [other for other in keys if other != key]
    groups: dict[str, list[tuple[float, MetricSpread]]] = defaultdict(list)
    for one in points:
        at, spread = one.point[key], one.metrics.get(metric)
        if is_number(at) and spread is not None:
            named = (f"{other.rpartition('.')[2]} {one.point[other]}" for other in others)
            groups[", ".join(named)].append((float(at), spread))
    places = [at for found in groups.values() for at, _ in found]
    if not places:
        return None
    name = METRICS[metric]
    is_log = min(places) > 0 and max(places) / min(places) >= _LOG_RATIO
    plot = Plot(name[:1].upper() + name[1:], PlotAxis(key, log=is_log), PlotAxis(name, "µm"))
    for colour, (label, found) in enumerate(groups.items()):
        x, spreads = zip(*sorted(found, key=lambda pair: pair[0]), strict=True)
        means, low, high = ([one[part] for one in spreads] for part in (0, 2, 3))
        if len(x) > 1 and low != high:
            plot.band(x, low, high, colour=colour)
        plot.line(x, means, label if len(groups) <= COLOURS else "", colour=colour)
        plot.points(x, means, colour=colour)
    return plot


def _write_table(page: Report, rows: Sequence[RunRow], keys: Sequence[str]) -> None:
    page.add(Section("Runs"))
    shown = rows[-_MOST_ROWS:]
    head = [*keys, "ending", *(f"{name}, µm" for name in METRICS.values()), "tags", "note", "log"]
    cells = [
        [
            *("-" if (value := read_value(row, key)) is None else str(value) for key in keys),
            row.ending,
            *("-" if (um := getattr(row, name)) is None else f"{um:.1f}" for name in METRICS),
            " ".join(row.tags),
            row.note,
            row.path,
        ]
        for row in shown
    ]
    page.add(ReportTable(head, cells).drop_empty())
    if len(shown) < len(rows):
        page.add(Text(f"{len(rows) - len(shown)} older runs are in the figures, not in the table."))
