"""A comparison as a report: for a terminal, as one document, and as a page with its plots."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.compare.comparison import OWN_PLANT, Comparison, ComparisonGap
from pamctl.log import Log
from pamctl.report.figure import MUTED, Plot, PlotAxis, plot_apart
from pamctl.report.report import SIGNAL_DISPLAYS, Figure, Report, ReportTable, Section, Text
from pamctl.report.reported_run import Floats, ReportedRun
from pamctl.report.run_motion import make_time_axis, mark_moments

_UM, _KPA = 1e6, 1e-3
_Models = Mapping[str, Comparison]


def report_comparison(path: Path, found: _Models, log: Log | None = None) -> Report:
    """Return the gaps of every model to a log; with its plots where the whole log is given."""
    comparisons = [*found.values()]
    measured = comparisons[0].measured
    coupled, alone = ([], []) if log is None else _draw_plots(log, found)
    report = Report(
        f"Model against {path.name}",
        f"{path}: {len(measured)} ticks from {measured.t_s[0]:.3f} s on, model minus measurement",
        subtitle=", ".join(found),
        document=_make_document(path, found),
    )
    report.add(Section("The gaps"), ReportTable(*list_gaps(found)).drop_empty())
    if coupled:
        caption = "The simulation with the logged command, and its gap."
        report.add(
            Section("The coupled model, driven by the logged command"), Figure(coupled, caption)
        )
    report.add(Section("Each block alone, driven by the other's measured signal"))
    if alone:
        report.add(
            Figure(
                alone,
                "Model minus measurement: the mechanics driven by the measured pressure or force, "
                "the pressure block by the command and the measured position.",
            )
        )
    report.add(ReportTable(*list_regimes(found), "By regime, RMS.").drop_empty())
    for again_s in {c.again_s for c in comparisons} - {None}:
        report.add(
            Text(
                f"This axis forgets nothing: the model begins again every {again_s:g} s from the "
                "measured state, as in a diagnosis."
            )
        )
    said = dict.fromkeys(text for comparison in comparisons for text in comparison.unused)
    report.add(*map(Text, said))
    frozen = comparisons[0].frozen
    if frozen is not None:
        report.add(Text(f"A sensor is frozen at {int(frozen.sum())} ticks: they count in no gap."))
    return report.add(Text(f"next: `{_suggest_next(path, found)}`"))


def list_gaps(found: _Models) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: the gaps of every model, however it is driven."""
    header = ["model", "driven", "position RMS, µm", "max, µm", "pressure RMS, kPa", "max, kPa"]
    rows = [
        [
            name,
            way.way,
            *(_format_cell(value * _UM) for value in comparison.gap(way, "position_m")),
            *(_format_cell(value * _KPA) for value in comparison.gap(way, "pressure_pa")),
        ]
        for name, comparison in found.items()
        for way in comparison.ways
    ]
    return header, rows


def list_regimes(found: _Models) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: the gaps of each block alone in each part of the run, RMS."""
    header = ["regime", "ticks"]
    for name in found:
        of = f"{name}: " if len(found) > 1 else ""
        header += [f"{of}position, µm", f"{of}pressure, kPa"]
    rows = []
    for regimes in zip(*(comparison.regimes() for comparison in found.values()), strict=True):
        cells = [
            _format_cell(value)
            for regime in regimes
            for value in (regime.position_m.rms * _UM, regime.pressure_pa.rms * _KPA)
        ]
        rows.append([regimes[0].name, str(regimes[0].ticks), *cells])
    return header, rows


def _suggest_next(path: Path, found: _Models) -> str:
    plants = [f" --plant {name}" for name in found if name != OWN_PLANT]
    log, plant = shlex.quote(str(path)), plants[0] if plants else ""
    return f"pamctl diagnose {log}{plant} --out diagnosis  # names what the model lacks"


def _format_cell(value: float) -> str:
    return "-" if value != value else f"{value:.{1 if value >= 10 else 3}f}"


def _make_document(path: Path, found: _Models) -> dict[str, Any]:
    """Return the gaps of every model as one document; SI, None where there is no gap."""
    measured = next(iter(found.values())).measured
    return {
        "schema": 1,
        "path": str(path),
        "from_t_s": float(measured.t_s[0]),
        "ticks": len(measured),
        "plants": [
            {
                "plant": name,
                "unused": [*comparison.unused],
                "gap": {
                    way.way.replace(" ", "_"): {
                        signal: _gap_fields(comparison.gap(way, signal))
                        for signal in ("position_m", "pressure_pa")
                    }
                    for way in comparison.all_ways
                },
                "regimes": [
                    {
                        "regime": regime.name,
                        "ticks": regime.ticks,
                        "position_m": _gap_fields(regime.position_m),
                        "pressure_pa": _gap_fields(regime.pressure_pa),
                    }
                    for regime in comparison.regimes()
                ],
            }
            for name, comparison in found.items()
        ],
        "next": _suggest_next(path, found),
    }


def _gap_fields(gap: ComparisonGap) -> dict[str, float | None]:
    return {name: None if value != value else value for name, value in gap._asdict().items()}


_ALONE = {"position_m": "Mechanics alone", "pressure_pa": "Pressure block alone"}


class _View(NamedTuple):
    """The time axis of all plots, with its values, and the colour of each model."""

    time: PlotAxis
    t_s: Floats
    colours: Mapping[str, int]


def _draw_plots(log: Log, found: _Models) -> tuple[list[Plot], list[Plot]]:
    """Draw every model beside the measurement, and the gap between them: coupled, and alone."""
    run = ReportedRun(log, log.path.stem)
    measured = next(iter(found.values())).measured
    t_s = measured.t_s - measured.t_s[0]
    axis = PlotAxis(make_time_axis([run]).label, "s", low=0.0, high=float(t_s[-1]), tight=True)
    view = _View(axis, t_s, {name: colour for colour, name in enumerate(found)})
    has_coupled = any(
        c.coupled.position_m is not None or c.coupled.pressure_pa is not None
        for c in found.values()
    )
    coupled = [
        plot
        for signal in _ALONE
        for draw in (_plot_signal, _plot_coupled_gap)
        for plot in (_plot_models(found, partial(draw, view, signal)) if has_coupled else ())
    ]
    alone = [
        plot
        for signal in _ALONE
        for plot in _plot_models(found, partial(_plot_gap_alone, view, signal))
    ]
    if coupled and measured.valve_v is not None:
        valve = Plot("Valve command", axis, PlotAxis("command", "V"), height_px=120)
        coupled.append(valve.line(t_s, measured.valve_v, step=True, colour=MUTED))
    mark_moments([*coupled, *alone], run.moments)
    return coupled, alone


def _plot_models(found: _Models, draw: Callable[[_Models], Plot]) -> list[Plot]:
    plots = plot_apart(lambda names: draw({name: found[name] for name in names}), [*found])
    return [plot for plot in plots if plot.marks]


def _plot_signal(view: _View, signal: str, found: _Models) -> Plot:
    shown = SIGNAL_DISPLAYS[signal]
    plot = Plot(shown.title, view.time, PlotAxis(shown.short, shown.unit))
    measured = getattr(next(iter(found.values())).measured, signal)
    if measured is not None:
        plot.line(view.t_s, shown.factor * measured, "measured", colour=MUTED, thick=True)
    for name, comparison in found.items():
        model = getattr(comparison.coupled, signal)
        if model is not None:
            plot.line(view.t_s, shown.factor * model, name, colour=view.colours[name])
    return plot


def _plot_coupled_gap(view: _View, signal: str, found: _Models) -> Plot:
    models = {name: getattr(one.coupled, signal) for name, one in found.items()}
    title = f"{SIGNAL_DISPLAYS[signal].title}, model \N{MINUS SIGN} measurement"
    return _plot_gap(title, view, signal, found, models)


def _plot_gap_alone(view: _View, signal: str, found: _Models) -> Plot:
    models = {
        name: one.mechanics.position_m if signal == "position_m" else one.pressure_block.pressure_pa
        for name, one in found.items()
    }
    return _plot_gap(_ALONE[signal], view, signal, found, models)


def _plot_gap(
    title: str,
    view: _View,
    signal: str,
    found: _Models,
    models: Mapping[str, Floats | None],
) -> Plot:
    shown = SIGNAL_DISPLAYS[signal]
    plot = Plot(title, view.time, PlotAxis("gap", shown.gap_unit), height_px=130)
    for name, model in models.items():
        measured = getattr(found[name].measured, signal)
        if model is not None and measured is not None:
            gap = shown.gap_factor * (model - measured)
            plot.line(view.t_s, gap, name, colour=view.colours[name])
    return plot
