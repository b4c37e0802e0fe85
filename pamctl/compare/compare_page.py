"""The plots of a comparison, on one self-contained page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from pamctl.compare.coupled_gap import Comparison
from pamctl.report.drawing.svg import MUTED, PlotAxis, SvgPlot
from pamctl.report.html_page import Page

_TIME = PlotAxis("time", "s", tight=True)


def draw_comparison_page(log: str, found: Mapping[str, Comparison]) -> Page:
    """Draw every model beside the measurement, and the gap between them."""
    page = Page(f"Model against {log}", ", ".join(found))
    first = next(iter(found.values()))
    t_s, measured = first.measured.t_s, first.measured
    page.section("The coupled model, driven by the logged command")
    page.figure(*_plot_coupled(t_s, found), caption="The simulation with the logged command.")
    page.section("Each block alone")
    page.figure(
        *_plot_blocks(t_s, found),
        caption="Model minus measurement: the mechanics driven by the measured pressure, the "
        "pressure block by the command and the measured position.",
    )
    if measured.valve_v is not None:
        page.section("The command")
        valve = SvgPlot("Valve command", _TIME, PlotAxis("command", "V"))
        page.figure(valve.line(t_s, measured.valve_v, step=True))
    return page


def _plot_coupled(t_s: NDArray[np.float64], found: Mapping[str, Comparison]) -> Iterator[SvgPlot]:
    measured = next(iter(found.values())).measured
    for title, unit, scale, signal in (
        ("Displacement", "mm", 1e3, "position_m"),
        ("Pressure", "kPa", 1e-3, "pressure_pa"),
    ):
        plot = SvgPlot(title, _TIME, PlotAxis(title.lower(), unit))
        seen = getattr(measured, signal)
        if seen is not None:
            plot.line(t_s, scale * seen, "measured", colour=MUTED)
        for colour, (name, comparison) in enumerate(found.items()):
            model = getattr(comparison.coupled, signal)
            if model is not None:
                plot.line(t_s, scale * model, name, colour=colour)
        yield plot


def _plot_blocks(t_s: NDArray[np.float64], found: Mapping[str, Comparison]) -> Iterator[SvgPlot]:
    position = SvgPlot("Mechanics", _TIME, PlotAxis("displacement gap", "um"))
    pressure = SvgPlot("Pressure block", _TIME, PlotAxis("pressure gap", "kPa"))
    for colour, (name, comparison) in enumerate(found.items()):
        measured = comparison.measured
        model_m, model_pa = comparison.mechanics.position_m, comparison.pressure_block.pressure_pa
        if model_m is not None and measured.position_m is not None:
            position.line(t_s, 1e6 * (model_m - measured.position_m), name, colour=colour)
        if model_pa is not None and measured.pressure_pa is not None:
            pressure.line(t_s, 1e-3 * (model_pa - measured.pressure_pa), name, colour=colour)
    yield position
    yield pressure
