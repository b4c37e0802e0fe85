"""The tables and plots of a comparison, on one self-contained page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

from pamctl.compare.compare_text import list_gaps, list_regimes
from pamctl.compare.coupled_gap import Comparison
from pamctl.log import Log
from pamctl.report.drawing.svg import MUTED, PlotAxis, SvgPlot, plot_apart
from pamctl.report.html_page import Page
from pamctl.report.motion_section import make_time_axis, mark_moments
from pamctl.report.reported_run import Floats, ReportedRun


class _Signal(NamedTuple):
    """A signal that models are held to: how it and its gap are shown."""

    name: str
    title: str
    unit: str
    scale: float
    gap_unit: str
    gap_scale: float


_SIGNALS = (
    _Signal("position_m", "Displacement", "mm", 1e3, "µm", 1e6),
    _Signal("pressure_pa", "Pressure", "kPa", 1e-3, "kPa", 1e-3),
)
_ALONE = {"position_m": "Mechanics alone", "pressure_pa": "Pressure block alone"}
_Models = Mapping[str, Comparison]


class _View(NamedTuple):
    """The time axis of all plots, with its values, and the colour of each model."""

    time: PlotAxis
    t_s: Floats
    colours: Mapping[str, int]


def draw_comparison_page(log: Log, found: _Models) -> Page:
    """Draw every model beside the measurement, and the gap between them."""
    run = ReportedRun(log, log.path.stem)
    measured = next(iter(found.values())).measured
    t_s = measured.t_s - measured.t_s[0]
    axis = PlotAxis(make_time_axis([run]).label, "s", low=0.0, high=float(t_s[-1]), tight=True)
    view = _View(axis, t_s, {name: colour for colour, name in enumerate(found)})
    coupled = [
        plot
        for signal in _SIGNALS
        for draw in (_plot_signal, _plot_coupled_gap)
        for plot in _plot_models(found, partial(draw, view, signal))
    ]
    alone = [
        plot
        for signal in _SIGNALS
        for plot in _plot_models(found, partial(_plot_gap_alone, view, signal))
    ]
    valve = SvgPlot("Valve command", axis, PlotAxis("command", "V"), height_px=120)
    if measured.valve_v is not None:
        coupled.append(valve.line(t_s, measured.valve_v, step=True, colour=MUTED))
    mark_moments([*coupled, *alone], run.moments)

    page = Page(f"Model against {log.path.name}", ", ".join(found))
    page.section("The gaps")
    page.table(*list_gaps(found), caption="Model minus measurement.")
    page.section("The coupled model, driven by the logged command")
    page.figure(*coupled, caption="The simulation with the logged command, and its gap.")
    page.section("Each block alone")
    page.figure(
        *alone,
        caption="Model minus measurement: the mechanics driven by the measured pressure, the "
        "pressure block by the command and the measured position.",
    )
    page.table(*list_regimes(found), caption="Each block alone, by regime, RMS.")
    return page


def _plot_models(found: _Models, draw: Callable[[_Models], SvgPlot]) -> list[SvgPlot]:
    plots = plot_apart(lambda names: draw({name: found[name] for name in names}), [*found])
    return [plot for plot in plots if plot.x_data]


def _plot_signal(view: _View, signal: _Signal, found: _Models) -> SvgPlot:
    plot = SvgPlot(signal.title, view.time, PlotAxis(signal.title.lower(), signal.unit))
    measured = getattr(next(iter(found.values())).measured, signal.name)
    if measured is not None:
        plot.line(view.t_s, signal.scale * measured, "measured", colour=MUTED, thick=True)
    for name, comparison in found.items():
        model = getattr(comparison.coupled, signal.name)
        if model is not None:
            plot.line(view.t_s, signal.scale * model, name, colour=view.colours[name])
    return plot


def _plot_coupled_gap(view: _View, signal: _Signal, found: _Models) -> SvgPlot:
    models = {name: getattr(one.coupled, signal.name) for name, one in found.items()}
    return _plot_gap(
        f"{signal.title}, model \N{MINUS SIGN} measurement", view, signal, found, models
    )


def _plot_gap_alone(view: _View, signal: _Signal, found: _Models) -> SvgPlot:
    models = {
        name: one.mechanics.position_m
        if signal.name == "position_m"
        else one.pressure_block.pressure_pa
        for name, one in found.items()
    }
    return _plot_gap(_ALONE[signal.name], view, signal, found, models)


def _plot_gap(
    title: str,
    view: _View,
    signal: _Signal,
    found: _Models,
    models: Mapping[str, Floats | None],
) -> SvgPlot:
    plot = SvgPlot(title, view.time, PlotAxis("gap", signal.gap_unit), height_px=130)
    for name, model in models.items():
        measured = getattr(found[name].measured, signal.name)
        if model is not None and measured is not None:
            gap = signal.gap_scale * (model - measured)
            plot.line(view.t_s, gap, name, colour=view.colours[name])
    return plot
