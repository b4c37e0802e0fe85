"""The law from inside: the phase planes of its error and the terms of its command."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.report.html_page import Page
from pamctl.report.motion_section import MM, time_axis
from pamctl.report.reported_run import Run
from pamctl.report.summary_section import MICRO
from pamctl.report.svg import Axis, Plot


def write_law(page: Page, runs: Sequence[Run]) -> None:
    """Write phase planes and terms of the runs in which a law tracked something."""
    lawful = [run for run in runs if run.error_m is not None]
    # Where one tracked, a run that came to nothing would only hide it by its error.
    lawful = [run for run in lawful if run.tracked.any()] or lawful
    if not lawful:
        return
    page.section("Law")
    e = Axis("e", "µm")
    surface = Plot("Sliding surface", e, Axis("s", "m/s²"), height_px=260)
    plane = Plot("Phase plane", e, Axis("e'", "mm/s"), height_px=260)
    with_surface = False
    for colour, run in enumerate(lawful):
        error_um = run.error_m[run.pursued] * MICRO  # type: ignore[index]
        label = run.name if len(lawful) > 1 else ""
        rate, s = run.column("error_rate_m_per_s", MM), run.column("surface_m_per_s2")
        if s is not None:
            with_surface = True
            surface.curve(error_um, s[run.pursued], label, colour=colour)
        if rate is not None:
            plane.curve(error_um, rate[run.pursued], label, colour=colour)
    if with_surface:
        surface.level(0.0, "s = 0")
    page.grid(
        *([surface, plane] if with_surface else [plane]),
        caption="While tracking and resting, or, where it came to neither, in the approach. "
        "On the surface s = 0 of Eq. 11 the error dies out as its poles say; the distance from it "
        "is what the robust term works on.",
    )
    _terms(page, lawful)


def _terms(page: Page, runs: Sequence[Run]) -> None:
    plots = []
    for run in runs:
        equivalent, robust = run.column("equivalent_v"), run.column("robust_v")
        if equivalent is None or robust is None:
            continue
        pid = run.meta.get("law") == "pid"
        names = ("proportional and derivative", "integral") if pid else ("u_eq", "u_rb")
        title = "Terms of the command" + (f", {run.name}" if len(runs) > 1 else "")
        plot = Plot(title, time_axis(runs), Axis("u", "V"), height_px=150)
        over = run.t_s[run.pursued]
        plot.line(over, equivalent[run.pursued], names[0])
        plot.line(over, robust[run.pursued], names[1], colour=1)
        plots.append(plot)
    if plots:
        page.figure(*plots, caption="What the command is made of.")
