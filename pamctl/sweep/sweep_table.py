"""The result of a sweep: figures of merit of each point, over its repeats."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Mapping, Sequence
from io import StringIO
from typing import Any, NamedTuple

from pamctl.json_text import to_json
from pamctl.runs.run_row import METRICS, RunRow


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


def format_points(points: Sequence[SweepPoint]) -> str:
    """Return a table for a terminal: mean and standard deviation of each metric."""
    keys = list(points[0].point) if points else []
    cells = [[*keys, "runs", "max um", "RMS um", "steady um"]]
    for one in points:
        failed = "".join(f", {count} {ending}" for ending, count in one.failed.items())
        metrics = [_format_spread(one.metrics.get(name)) for name in METRICS]
        cells.append([*(str(one.point[key]) for key in keys), f"{one.runs}{failed}", *metrics])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in cells
    )


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
