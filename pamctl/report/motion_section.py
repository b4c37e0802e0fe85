"""Reference, motion, pressure and command over time."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from pamctl.log.moments import Moment
from pamctl.report.drawing.svg import MUTED, PlotAxis, SvgPlot, plot_apart
from pamctl.report.html_page import Page
from pamctl.report.reported_run import ReportedRun, law_name, paper_rows
from pamctl.report.summary_section import MICRO, rms_of_finite

KPA, MM = 1e-3, 1e3


def make_time_axis(runs: Sequence[ReportedRun]) -> PlotAxis:
    """Return the time axis of these runs: the same in every figure that shows them."""
    since = "time since homing" if any(run.has_homing for run in runs) else "time"
    ends_s = [float(run.t_s[run.shown][-1]) for run in runs if len(run)]
    return PlotAxis(since, "s", low=0.0, high=max(ends_s, default=0.0) or None, tight=True)


def write_motion(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write displacement, error, pressure and command of runs of one experiment."""
    page.section("Motion")
    for group in group_by_experiment(runs):
        if len(group) < len(runs):
            page.heading(", ".join(run.name for run in group))
        makers = (_plot_displacement, _plot_error, _plot_pressure, _plot_force, _plot_command)
        plots = [plot for make in makers for plot in plot_runs(group, make)]
        if not plots:
            page.text("The log has no displacement, no pressure and no command to show.")
            continue
        page.figure(*plots, caption=_make_caption(group))


def plot_runs(
    group: Sequence[ReportedRun], make: Callable[[Sequence[ReportedRun]], SvgPlot | None]
) -> list[SvgPlot]:
    """Return one plot of these runs, or one for each run; with their moments."""

    def draw(runs: Sequence[ReportedRun]) -> SvgPlot | None:
        plot = make(runs)
        if plot is not None and len(runs) < len(group):
            plot.title = f"{plot.title}, {runs[0].name}"
            plot.height_px = min(plot.height_px, _SMALL_PX)
        for run in runs:
            shown = [plot] if plot is not None else []
            mark_moments(shown, run.moments, MUTED if len(runs) == 1 else run.colour)
        return plot

    return plot_apart(draw, group)


MOST_MOMENTS = 30
_SMALL_PX = 110


def mark_moments(plots: Iterable[SvgPlot], moments: Sequence[Moment], colour: int = MUTED) -> None:
    """Draw a line through the plots at each mark, change of gains and trip, with its name.

    Of more than `MOST_MOMENTS` the first ones are drawn: the table of a run has all.
    """
    for plot in plots:
        for at_s, said in moments[:MOST_MOMENTS]:
            plot.place(at_s, textwrap.shorten(said, 24, placeholder="..."), colour=colour)


def group_by_experiment(runs: Sequence[ReportedRun]) -> list[list[ReportedRun]]:
    """Return the runs in groups of the same experiment, which share a time axis."""
    groups: list[list[ReportedRun]] = []
    for run in runs:
        asked = run.log.config.get("experiment")
        for group in groups:
            if group[0].log.config.get("experiment") == asked:
                group.append(run)
                break
        else:
            groups.append([run])
    return groups


def _make_caption(group: Sequence[ReportedRun]) -> str:
    said = ["Every extreme is shown."]
    if any(not run.shown.all() for run in group):
        said.append("Homing and the final stop are not shown.")
    if _find_error_range_um(group) != (None, None):
        said.append("The axis cuts the error of a run that never reached tracking.")
    experiment = group[0].paper_experiment
    if experiment:
        figures = ", ".join(
            f"{law_name(row.law)} {row.merit.max_m * MICRO:.0f} µm"
            for row in paper_rows(experiment)
        )
        said.append(f"Largest errors of the paper's rig in this experiment: {figures}.")
    return " ".join(said)


def _label_run(group: Sequence[ReportedRun], run: ReportedRun, alone: str) -> str:
    return run.name if len(group) > 1 else alone


def _plot_displacement(group: Sequence[ReportedRun]) -> SvgPlot | None:
    plot = SvgPlot("Displacement", make_time_axis(group), PlotAxis("displacement", "mm"))
    reference = group[0].column("reference_m", MM)
    if reference is not None:
        shown = group[0].shown
        plot.line(group[0].t_s[shown], reference[shown], "reference", colour=MUTED, thick=True)
    drawn = _draw_column(plot, group, "position_m", MM, "measured")
    return plot if drawn or reference is not None else None


def _plot_error(group: Sequence[ReportedRun]) -> SvgPlot | None:
    low, high = _find_error_range_um(group)
    error_axis = PlotAxis("x \N{MINUS SIGN} x_D", "µm", low=low, high=high)
    plot = SvgPlot("Tracking error", make_time_axis(group), error_axis)
    drawn = False
    for run in group:
        if run.error_m is None:
            continue
        drawn = True
        error_um = run.error_m * MICRO
        if run.tracked.any():
            band = rms_of_finite(error_um[run.tracked])
            over = run.t_s[run.tracked][[0, -1]]
            said = _label_run(group, run, "error") + f", band ± RMS {band:.1f} µm"
            plot.band(over, -band, band, colour=run.colour)
        else:
            said = _label_run(group, run, "error")
        plot.line(run.t_s[run.shown], error_um[run.shown], said, colour=run.colour)
    for row in paper_rows(group[0].paper_experiment):
        for side in (-1.0, 1.0):
            label = f"paper's {law_name(row.law)}, max" if side > 0 else ""
            plot.level(side * row.merit.max_m * MICRO, label)
    return plot if drawn else None


def _find_error_range_um(group: Sequence[ReportedRun]) -> tuple[float | None, float | None]:
    """Return the ends of the error axis, if a run that never tracked would hide the others."""
    tracked = [r.error_m[r.tracked] for r in group if r.error_m is not None and r.tracked.any()]
    if not tracked or len(tracked) == len(group):
        return None, None
    error_um = np.concatenate(tracked) * MICRO
    margin = 0.25 * max(1.0, float(np.nanmax(error_um) - np.nanmin(error_um)))
    return float(np.nanmin(error_um)) - margin, float(np.nanmax(error_um)) + margin


def _plot_pressure(group: Sequence[ReportedRun]) -> SvgPlot | None:
    plot = SvgPlot("Pressure", make_time_axis(group), PlotAxis("absolute", "kPa"), height_px=140)
    limit = group[0].log.config.get("rig", {}).get("limits", {}).get("pressure_pa")
    if isinstance(limit, int | float):
        plot.level(limit * KPA, "limit")
    return plot if _draw_column(plot, group, "pressure_pa", KPA, "measured") else None


def _plot_force(group: Sequence[ReportedRun]) -> SvgPlot | None:
    plot = SvgPlot("Force", make_time_axis(group), PlotAxis("pull", "N"), height_px=140)
    return plot if _draw_column(plot, group, "force_n", 1.0, "measured") else None


def _plot_command(group: Sequence[ReportedRun]) -> SvgPlot | None:
    """Plot the law's command and the voltage at the valve, with a dot where either was limited."""
    plot = SvgPlot("Command", make_time_axis(group), PlotAxis("u", "V"), height_px=140)
    if len(group) == 1 and (asked := group[0].column("command_v")) is not None:
        shown = group[0].shown
        plot.line(group[0].t_s[shown], asked[shown], "command of the law", colour=MUTED, thick=True)
    drawn = _draw_column(plot, group, "valve_v", 1.0, "at the valve", step=True)
    for run in group:
        cut, valve = _find_cut_ticks(run) & run.shown, run.column("valve_v")
        if valve is not None and cut.any():
            share = cut.sum() / max(1, run.shown.sum())
            said = _label_run(group, run, "cut or saturated") + f" ({share:.2%} of the ticks cut)"
            plot.points(run.t_s[cut], valve[cut], said, colour=1 if len(group) == 1 else 6)
    return plot if drawn else None


def _find_cut_ticks(run: ReportedRun) -> np.ndarray:
    """Return the ticks in which the law or safety limited the command."""
    saturated = run.log.columns.get("saturated", np.zeros(len(run), bool))
    verdicts = run.log.columns.get("verdicts", np.zeros(len(run), np.int64))
    held_back: np.ndarray = np.asarray(saturated, bool) | (np.asarray(verdicts) != 0)
    return held_back


def _draw_column(
    plot: SvgPlot,
    group: Sequence[ReportedRun],
    column: str,
    scale: float,
    alone: str,
    *,
    step: bool = False,
) -> bool:
    drawn = False
    for run in group:
        values = run.column(column, scale)
        if values is not None:
            drawn = True
            label = _label_run(group, run, alone)
            plot.line(run.t_s[run.shown], values[run.shown], label, colour=run.colour, step=step)
    return drawn
