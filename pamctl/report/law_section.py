"""The law from inside: the phase planes of its error and the terms of its command."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.control.law import Term
from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.report.motion_section import MM, make_time_axis, mark_moments
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
    caption = "While tracking and resting; a run that came to neither is shown in its approach."
    if surfaces:
        caption += (
            " On the sliding surface, where its value is 0, the error dies out as the law's poles "
            "say. The robust term works on the distance from the surface."
        )
    page.grid(*surfaces, _plot_phase_plane(lawful), caption=caption)
    _write_terms(page, lawful)


def _write_equations(page: Page, runs: Sequence[ReportedRun]) -> None:
    equations = {run.law.title: run.law.equation for run in runs if run.law.equation}
    if equations:
        page.points(*(f"{title}: {equation}" for title, equation in equations.items()))


def _plot_surfaces(runs: Sequence[ReportedRun]) -> list[SvgPlot]:
    """Draw one plot for each kind of surface that the laws of the runs have."""
    plots: dict[Term, SvgPlot] = {}
    for colour, run in enumerate(runs):
        term, s = run.law.terms.surface, run.column("surface_m_per_s2")
        if term is None or s is None:
            continue
        if term not in plots:
            axis = PlotAxis(term.symbol, term.unit)
            plots[term] = SvgPlot("Sliding surface", _ERROR, axis, height_px=260)
        error_um = run.error_m[run.law_at_work] * MICRO  # type: ignore[index]
        plots[term].curve(error_um, s[run.law_at_work], _label_run(runs, run), colour=colour)
    for term, plot in plots.items():
        plot.level(0.0, f"{term.symbol} = 0")
    return list(plots.values())


def _plot_phase_plane(runs: Sequence[ReportedRun]) -> SvgPlot:
    plane = SvgPlot("Phase plane", _ERROR, PlotAxis("e'", "mm/s"), height_px=260)
    for colour, run in enumerate(runs):
        rate = run.column("error_rate_m_per_s", MM)
        if rate is not None:
            error_um = run.error_m[run.law_at_work] * MICRO  # type: ignore[index]
            plane.curve(error_um, rate[run.law_at_work], _label_run(runs, run), colour=colour)
    return plane


def _label_run(runs: Sequence[ReportedRun], run: ReportedRun) -> str:
    return run.name if len(runs) > 1 else ""


def _write_terms(page: Page, runs: Sequence[ReportedRun]) -> None:
    plots = []
    for run in runs:
        equivalent, robust = run.column("equivalent_v"), run.column("robust_v")
        if equivalent is None or robust is None:
            continue
        title = "Terms of the command" + (f", {run.name}" if len(runs) > 1 else "")
        plot = SvgPlot(title, make_time_axis(runs), PlotAxis("u", "V"), height_px=150)
        over, terms = run.t_s[run.law_at_work], run.law.terms
        plot.line(over, equivalent[run.law_at_work], _name_term(terms.equivalent))
        plot.line(over, robust[run.law_at_work], _name_term(terms.robust), colour=1)
        mark_moments([plot], [run])
        plots.append(plot)
    if plots:
        page.figure(*plots, caption="What the command is made of.")


def _name_term(term: Term) -> str:
    return f"{term.symbol}, {term.meaning}" if term.meaning else term.symbol
