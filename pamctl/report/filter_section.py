"""The effect of the filters: how much they change the displacement, and a close-up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pamctl.report.drawing.svg import MUTED, PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.report.motion_section import MM, group_by_experiment, make_time_axis, plot_runs
from pamctl.report.reported_run import ReportedRun
from pamctl.report.summary_section import MICRO

CLOSE_S = 0.06
"""Time before and after the place of the close-up."""


def write_filtering(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write the effect of LPF_1 and LPF_2 for each run that has a filtered displacement."""
    filtering = [run for run in runs if _compute_shift_um(run) is not None]
    if not filtering:
        return
    page.section("Filters")
    for group in group_by_experiment(filtering):
        page.figure(
            *plot_runs(group, _plot_shift),
            caption="The difference that the filter makes to the displacement, lag included.",
        )
    for run in filtering:
        if (close := _plot_close_look(run)) is not None:
            page.grid(*close, caption=_make_caption(run, alone=len(filtering) == 1))


def _plot_shift(group: Sequence[ReportedRun]) -> SvgPlot:
    axis = PlotAxis("LPF_1", "µm")
    plot = SvgPlot("Filtered minus raw displacement", make_time_axis(group), axis, height_px=120)
    for run in group:
        moved = _compute_shift_um(run)
        label = run.name if len(group) > 1 else ""
        plot.line(run.t_s[run.shown], moved[run.shown], label, colour=run.colour)  # type: ignore[index]
    return plot


def _compute_shift_um(run: ReportedRun) -> np.ndarray | None:
    raw, filtered = run.column("position_m", MICRO), run.column("position_filtered_m", MICRO)
    return None if raw is None or filtered is None else filtered - raw


def _make_caption(run: ReportedRun, *, alone: bool) -> str:
    controller = run.log.config.get("controller", {})
    cutoffs = ", ".join(
        f"{name} {controller[key]:g} Hz"
        for name, key in (("LPF_1", "lpf1_hz"), ("LPF_2", "lpf2_hz"))
        if isinstance(controller.get(key), int | float)
    )
    whose = "" if alone else f"{run.name}. "
    return f"{whose}Close-up of the place where the filter changes the displacement most. {cutoffs}"


def _plot_close_look(run: ReportedRun) -> list[SvgPlot] | None:
    moved_um, error_m = _compute_shift_um(run), run.error_m
    if moved_um is None or error_m is None:
        return None
    moved = np.where(run.tracked, np.abs(moved_um), np.nan)
    if not np.isfinite(moved).any():
        return None
    middle_s = run.t_s[np.nanargmax(moved)]
    near = (np.abs(run.t_s - middle_s) <= CLOSE_S) & run.shown
    t_s, axis = run.t_s[near], PlotAxis(make_time_axis([run]).label, "s", tight=True)
    # Without the reference: the motion would hide a difference of micrometres.
    error_um = error_m[near] * MICRO
    close = SvgPlot("Error, close-up", axis, PlotAxis("x \N{MINUS SIGN} x_D", "µm"))
    close.line(t_s, error_um, "raw", colour=MUTED, step=True)
    close.line(t_s, error_um + moved_um[near], "after LPF_1")
    plots = [close]
    rate = run.column("error_rate_m_per_s", MM)
    if rate is not None and len(t_s) > 1:
        raw_rate = np.gradient(error_m[near] * MM, t_s)
        derivative = SvgPlot("Rate of the error, close-up", axis, PlotAxis("e'", "mm/s"))
        derivative.line(t_s, raw_rate, "raw difference", colour=MUTED)
        derivative.line(t_s, rate[near], "after LPF_2")
        plots.append(derivative)
    return plots
