"""The law from inside: the phase planes of its error and the terms of its command."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.report.motion_section import MM, make_time_axis
from pamctl.report.reported_run import ReportedRun
from pamctl.report.summary_section import MICRO


def write_law(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write phase planes and terms of the runs in which a law tracked something."""
    lawful = [run for run in runs if run.error_m is not None]
    # Where one tracked, a run that came to nothing would only hide it by its error.
    lawful = [run for run in lawful if run.tracked.any()] or lawful
    if not lawful:
        return
    page.section("Law")
    e = PlotAxis("e", "µm")
    surface = SvgPlot("Sliding surface", e, PlotAxis("s", "m/s²"), height_px=260)
    plane = SvgPlot("Phase plane", e, PlotAxis("e'", "mm/s"), height_px=260)
    with_surface = False
    for colour, run in enumerate(lawful):
        error_um = run.error_m[run.law_at_work] * MICRO  # type: ignore[index]
        label = run.name if len(lawful) > 1 else ""
        rate, s = run.column("error_rate_m_per_s", MM), run.column("surface_m_per_s2")
        if s is not None:
            with_surface = True
            surface.curve(error_um, s[run.law_at_work], label, colour=colour)
        if rate is not None:
            plane.curve(error_um, rate[run.law_at_work], label, colour=colour)
    if with_surface:
        surface.level(0.0, "s = 0")
    page.grid(
        *([surface, plane] if with_surface else [plane]),
        caption="While tracking and resting, or, where it came to neither, in the approach. "
        "On the surface s = 0 of Eq. 11 the error dies out as its poles say; the distance from it "
        "is what the robust term works on.",
    )
    _write_terms(page, lawful)


def _write_terms(page: Page, runs: Sequence[ReportedRun]) -> None:
    plots = []
    for run in runs:
        equivalent, robust = run.column("equivalent_v"), run.column("robust_v")
        if equivalent is None or robust is None:
            continue
        pid = run.meta.get("law") == "pid"
        names = ("proportional and derivative", "integral") if pid else ("u_eq", "u_rb")
        title = "Terms of the command" + (f", {run.name}" if len(runs) > 1 else "")
        plot = SvgPlot(title, make_time_axis(runs), PlotAxis("u", "V"), height_px=150)
        over = run.t_s[run.law_at_work]
        plot.line(over, equivalent[run.law_at_work], names[0])
        plot.line(over, robust[run.law_at_work], names[1], colour=1)
        plots.append(plot)
    if plots:
        page.figure(*plots, caption="What the command is made of.")
