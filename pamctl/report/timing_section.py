"""The timing of the loop: histograms, the worst ticks, the missed ticks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.report.reported_run import ReportedRun
from pamctl.simulate.merit import summarise_durations

WORST = 10
MICRO = 1e6
FASTEST_US, SLOWEST_US = 0.1, 1e6

_DURATIONS = (
    ("late_s", "wake-up behind deadline"),
    ("read_s", "reading the rig"),
    ("compute_s", "tick, sample to command"),
    ("write_s", "writing the rig"),
)


def write_timing(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write the durations of a tick's parts, and which ticks were late or missed."""
    page.section("Timing")
    for run in runs:
        if len(runs) > 1:
            page.heading(run.name)
        if run.fast:
            page.text("Simulated without a clock: there is no timing to show.")
            continue
        if len(run) < 2:
            page.text("Too few ticks for timing figures.")
            continue
        _write_spreads(page, run)
        _plot_histograms(page, run)
        _write_worst(page, run)
        _write_missed(page, run)


def _write_spreads(page: Page, run: ReportedRun) -> None:
    rows = []
    for name, label in _DURATIONS:
        values = run.column(name)
        if values is not None:
            found = summarise_durations(values[np.isfinite(values)])
            rows.append([label, *(f"{part * MICRO:.1f}" for part in found)])
    if rows:
        page.table(["µs", "p50", "p99", "max"], rows)


def _plot_histograms(page: Page, run: ReportedRun) -> None:
    plots = []
    for name, label in (("late_s", "wake-up behind deadline"), ("work", "read, tick and write")):
        values = _compute_work_s(run) if name == "work" else run.column(name)
        if values is None:
            continue
        edges = np.geomspace(FASTEST_US, SLOWEST_US, 141)
        counts, _ = np.histogram(np.clip(values * MICRO, FASTEST_US, SLOWEST_US), edges)
        used = np.flatnonzero(counts)
        first, last = max(0, used[0] - 2), min(len(counts), used[-1] + 3)
        duration = PlotAxis("duration (0.1 means 0.1 or less)", "µs", log=True, tight=True)
        plot = SvgPlot(
            label.capitalize(), duration, PlotAxis("ticks", low=0.5, log=True), height_px=150
        )
        plots.append(plot.bars(edges[first : last + 1], counts[first:last]))
    if plots:
        page.grid(*plots, caption="Both axes are logarithmic: a single tick is still a bar.")
        return
    steps_ms = np.diff(run.log["t_s"]) * 1e3
    # Steps that differ only by rounding become one bar, not many bars without width.
    usual_ms = float(np.median(steps_ms))
    over = (min(float(steps_ms.min()), 0.9 * usual_ms), max(float(steps_ms.max()), 1.1 * usual_ms))
    counts, edges = np.histogram(steps_ms, 81, over)
    plot = SvgPlot(
        "Time between samples", PlotAxis("step", "ms"), PlotAxis("ticks", low=0.5, log=True)
    )
    page.figure(plot.bars(edges, counts), caption="This log has no other timing data.")


def _compute_work_s(run: ReportedRun) -> np.ndarray | None:
    parts = [run.column(name) for name in ("read_s", "compute_s", "write_s")]
    known = [part for part in parts if part is not None]
    return np.sum(known, axis=0) if len(known) == len(parts) else None


def _write_worst(page: Page, run: ReportedRun) -> None:
    late, work = run.column("late_s"), _compute_work_s(run)
    if late is None or work is None:
        return
    cost = np.nan_to_num(late + work)
    worst = np.argsort(-cost, kind="stable")[:WORST]
    rows = [
        [
            str(run.log["tick"][i]),
            f"{run.t_s[i]:.3f}",
            *(f"{run.log[name][i] * MICRO:.1f}" for name, _ in _DURATIONS),
            str(run.log["missed"][i]),
        ]
        for i in worst
    ]
    page.table(
        ["tick", "at, s", "late", "read", "tick", "write", "missed before"],
        rows,
        caption=f"The {len(rows)} worst ticks, in µs.",
    )


def _write_missed(page: Page, run: ReportedRun) -> None:
    missed = run.log["missed"]
    at = np.flatnonzero(missed > 0)
    if not len(at):
        page.text("No tick was missed.")
        return
    largest = at[np.argsort(-missed[at], kind="stable")][:WORST]
    longest = ", ".join(f"{missed[i]} before {run.t_s[i]:.3f} s" for i in sorted(largest))
    page.text(f"{int(missed.sum())} ticks were missed in {len(at)} places; the most: {longest}.")
