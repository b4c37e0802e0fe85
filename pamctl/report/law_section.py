"""The law from inside: the phase planes of its error and the terms of its command."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pamctl.control.law import Term
from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.report.motion_section import (
    MM,
    group_by_experiment,
    make_time_axis,
    mark_moments,
)
from pamctl.report.reported_run import ReportedRun
from pamctl.report.summary_section import MICRO

_ERROR = PlotAxis("e", "µm")


def write_law(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write phase planes and terms of the runs in which a law tracked something."""
    lawful = [run for run in runs if run.error_m is not None]
    # Beside runs that tracked, the large error of a run that never did would hide the others.
    lawful = [run for run in lawful if run.tracked.any()] or lawful
    if not lawful:
        return
    page.section("Law")
    _write_equations(page, lawful)
    surfaces = _plot_surfaces(lawful)
    caption = (
        "While tracking and resting; a run that came to neither is shown in its approach. The "
        "stronger the colour, the more often the error was there, on a logarithmic scale."
    )
    if surfaces:
        caption += (
            " On the sliding surface, where its value is 0, the error dies out as the law's poles "
            "say. The robust term works on the distance from the surface."
        )
    page.grid(*surfaces, *_plot_phase_planes(lawful), caption=caption)
    _write_terms(page, lawful)


def _write_equations(page: Page, runs: Sequence[ReportedRun]) -> None:
    equations = {run.law.title: run.law.equation for run in runs if run.law.equation}
    if equations:
        page.points(*(f"{title}: {equation}" for title, equation in equations.items()))


def _plot_surfaces(runs: Sequence[ReportedRun]) -> list[SvgPlot]:
    """Return a plot for each run whose law has a sliding surface."""
    plots = []
    for run in runs:
        term, s = run.law.terms.surface, run.column("surface_m_per_s2")
        if term is not None and s is not None:
            axis = PlotAxis(term.symbol, term.unit)
            plot = _plot_density("Sliding surface", runs, run, axis, s)
            plots.append(plot.level(0.0, f"{term.symbol} = 0"))
    return plots


def _plot_phase_planes(runs: Sequence[ReportedRun]) -> list[SvgPlot]:
    axis, rates = PlotAxis("e'", "mm/s"), [run.column("error_rate_m_per_s", MM) for run in runs]
    return [
        _plot_density("Phase plane", runs, run, axis, rate)
        for run, rate in zip(runs, rates, strict=True)
        if rate is not None
    ]


def _plot_density(
    title: str, runs: Sequence[ReportedRun], run: ReportedRun, axis: PlotAxis, values: np.ndarray
) -> SvgPlot:
    """Return how often the error and `values`, shape (n,), went together while the law worked."""
    assert run.error_m is not None
    plot = SvgPlot(f"{title}{_name_run(runs, run)}", _ERROR, axis, height_px=240)
    error_um = run.error_m[run.law_at_work] * MICRO
    return plot.density(error_um, values[run.law_at_work], colour=run.colour)


def _name_run(runs: Sequence[ReportedRun], run: ReportedRun) -> str:
    return f", {run.name}" if len(runs) > 1 else ""


def _write_terms(page: Page, runs: Sequence[ReportedRun]) -> None:
    for group in group_by_experiment(runs):
        plots = []
        for run in group:
            equivalent, robust = run.column("equivalent_v"), run.column("robust_v")
            if equivalent is None or robust is None:
                continue
            title = f"Terms of the command{_name_run(runs, run)}"
            plot = SvgPlot(title, make_time_axis(group), PlotAxis("u", "V"), height_px=150)
            over, terms = run.t_s[run.law_at_work], run.law.terms
            plot.line(over, equivalent[run.law_at_work], _name_term(terms.equivalent))
            plot.line(over, robust[run.law_at_work], _name_term(terms.robust), colour=1)
            mark_moments([plot], run.moments)
            plots.append(plot)
        if plots:
            page.figure(*plots, caption="What the command is made of.")


def _name_term(term: Term) -> str:
    return f"{term.symbol}, {term.meaning}" if term.meaning else term.symbol
