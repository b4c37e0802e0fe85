"""A run over time and from inside: motion, and the terms of its law."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from pamctl.control.law import Term
from pamctl.control.law_registry import find_law
from pamctl.log.run_meta import Moment
from pamctl.offline.merit import find_paper_rows
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import MUTED, Plot, plot_apart
from pamctl.report.report import Figure, Points, Report, Section, Text
from pamctl.report.reported_run import MICRO, ReportedRun

KPA, MM = 1e-3, 1e3


def make_time_axis(runs: Sequence[ReportedRun]) -> PlotAxis:
    """Return the time axis of these runs: the same in every figure that shows them."""
    since = "time since homing" if any(run.has_homing for run in runs) else "time"
    ends_s = [float(run.t_s[run.shown][-1]) for run in runs if len(run)]
    return PlotAxis(since, "s", low=0.0, high=max(ends_s, default=0.0) or None, tight=True)


def write_motion(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write displacement, error, pressure and command of runs of one experiment."""
    page.add(Section("Motion"))
    for group in group_by_experiment(runs):
        if len(group) < len(runs):
            page.add(Section(", ".join(run.name for run in group), is_part=True))
        makers = (_plot_displacement, _plot_error, _plot_pressure, _plot_force, _plot_command)
        plots = [plot for make in makers for plot in plot_runs(group, make)]
        if not plots:
            page.add(Text("The log has no displacement, no pressure and no command to show."))
            continue
        page.add(Figure([*plots], _make_caption(group)))


def plot_runs(
    group: Sequence[ReportedRun], make: Callable[[Sequence[ReportedRun]], Plot | None]
) -> list[Plot]:
    """Return one plot of these runs, or one for each run; with their moments."""

    def draw(runs: Sequence[ReportedRun]) -> Plot | None:
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


def mark_moments(plots: Iterable[Plot], moments: Sequence[Moment], colour: int = MUTED) -> None:
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
            f"{find_law(row.law).title} {row.merit.max_m * MICRO:.0f} µm"
            for row in find_paper_rows(experiment)
        )
        said.append(f"Largest errors of the paper's rig in this experiment: {figures}.")
    return " ".join(said)


def _label_run(group: Sequence[ReportedRun], run: ReportedRun, alone: str) -> str:
    return run.name if len(group) > 1 else alone


def _plot_displacement(group: Sequence[ReportedRun]) -> Plot | None:
    plot = Plot("Displacement", make_time_axis(group), PlotAxis("displacement", "mm"))
    reference = group[0].column("reference_m", MM)
    if reference is not None:
        shown = group[0].shown
        plot.line(group[0].t_s[shown], reference[shown], "reference", colour=MUTED, thick=True)
    drawn = _draw_column(plot, group, "position_m", MM, "measured")
    return plot if drawn or reference is not None else None


def _plot_error(group: Sequence[ReportedRun]) -> Plot | None:
    low, high = _find_error_range_um(group)
    error_axis = PlotAxis("x \N{MINUS SIGN} x_D", "µm", low=low, high=high)
    plot = Plot("Tracking error", make_time_axis(group), error_axis)
    drawn = False
    for run in group:
        if run.error_m is None:
            continue
        drawn = True
        error_um = run.error_m * MICRO
        if run.tracked.any():
            known = error_um[run.tracked & np.isfinite(error_um)]
            band = float(np.sqrt(np.mean(known**2))) if len(known) else np.nan
            over = run.t_s[run.tracked][[0, -1]]
            said = _label_run(group, run, "error") + f", band ± RMS {band:.1f} µm"
            plot.band(over, -band, band, colour=run.colour)
        else:
            said = _label_run(group, run, "error")
        plot.line(run.t_s[run.shown], error_um[run.shown], said, colour=run.colour)
    for row in find_paper_rows(group[0].paper_experiment):
        for side in (-1.0, 1.0):
            label = f"paper's {find_law(row.law).title}, max" if side > 0 else ""
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


def _plot_pressure(group: Sequence[ReportedRun]) -> Plot | None:
    plot = Plot("Pressure", make_time_axis(group), PlotAxis("absolute", "kPa"), height_px=140)
    limit = group[0].log.config.get("rig", {}).get("limits", {}).get("pressure_pa")
    if isinstance(limit, int | float):
        plot.level(limit * KPA, "limit")
    return plot if _draw_column(plot, group, "pressure_pa", KPA, "measured") else None


def _plot_force(group: Sequence[ReportedRun]) -> Plot | None:
    plot = Plot("Force", make_time_axis(group), PlotAxis("pull", "N"), height_px=140)
    return plot if _draw_column(plot, group, "force_n", 1.0, "measured") else None


def _plot_command(group: Sequence[ReportedRun]) -> Plot | None:
    """Plot the law's command and the voltage at the valve, with a dot where either was limited."""
    plot = Plot("Command", make_time_axis(group), PlotAxis("u", "V"), height_px=140)
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
    plot: Plot,
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


_ERROR = PlotAxis("e", "µm")


def write_law(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write phase planes and terms of the runs in which a law tracked something."""
    lawful = [run for run in runs if run.error_m is not None]
    # Beside runs that tracked, the large error of a run that never did would hide the others.
    lawful = [run for run in lawful if run.tracked.any()] or lawful
    if not lawful:
        return
    page.add(Section("Law"))
    equations = {run.law.title: run.law.equation for run in lawful if run.law.equation}
    if equations:
        page.add(Points([f"{title}: {equation}" for title, equation in equations.items()]))
    surfaces = _plot_surfaces(lawful)
    caption = "While tracking and resting; a run that came to neither is shown in its approach."
    if surfaces:
        caption += (
            " On the sliding surface, where its value is 0, the error dies out as the law's poles "
            "say. The robust term works on the distance from the surface."
        )
    page.add(Figure([*surfaces, *_plot_phase_planes(lawful)], caption, is_grid=True))
    _write_terms(page, lawful)


def _plot_surfaces(runs: Sequence[ReportedRun]) -> list[Plot]:
    """Return a plot for each run whose law has a sliding surface."""
    plots = []
    for run in runs:
        term, s = run.law.terms.surface, run.column("surface_m_per_s2")
        if term is not None and s is not None:
            axis = PlotAxis(term.symbol, term.unit)
            plot = _plot_plane("Sliding surface", runs, run, axis, s)
            plots.append(plot.level(0.0, f"{term.symbol} = 0"))
    return plots


def _plot_phase_planes(runs: Sequence[ReportedRun]) -> list[Plot]:
    axis, rates = PlotAxis("e'", "mm/s"), [run.column("error_rate_m_per_s", MM) for run in runs]
    return [
        _plot_plane("Phase plane", runs, run, axis, rate)
        for run, rate in zip(runs, rates, strict=True)
        if rate is not None
    ]


def _plot_plane(
    title: str, runs: Sequence[ReportedRun], run: ReportedRun, axis: PlotAxis, values: np.ndarray
) -> Plot:
    """Return `values`, shape (n,), over the error while the law worked."""
    assert run.error_m is not None
    plot = Plot(f"{title}{_name_run(runs, run)}", _ERROR, axis, height_px=240)
    error_um = run.error_m[run.law_at_work] * MICRO
    return plot.points(error_um, values[run.law_at_work], colour=run.colour)


def _name_run(runs: Sequence[ReportedRun], run: ReportedRun) -> str:
    return f", {run.name}" if len(runs) > 1 else ""


def _write_terms(page: Report, runs: Sequence[ReportedRun]) -> None:
    for group in group_by_experiment(runs):
        plots = []
        for run in group:
            equivalent, robust = run.column("equivalent_v"), run.column("robust_v")
            if equivalent is None or robust is None:
                continue
            title = f"Terms of the command{_name_run(runs, run)}"
            plot = Plot(title, make_time_axis(group), PlotAxis("u", "V"), height_px=150)
            over, terms = run.t_s[run.law_at_work], run.law.terms
            plot.line(over, equivalent[run.law_at_work], _name_term(terms.equivalent))
            plot.line(over, robust[run.law_at_work], _name_term(terms.robust), colour=1)
            mark_moments([plot], run.moments)
            plots.append(plot)
        if plots:
            page.add(Figure([*plots], "What the command is made of."))


def _name_term(term: Term) -> str:
    return f"{term.symbol}, {term.meaning}" if term.meaning else term.symbol
