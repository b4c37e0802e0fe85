"""A comparison as a report: for a terminal, as one document, and as a page with its plots."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pamctl.diagnose.evidence.run_pieces import WARM_S
from pamctl.log import Log
from pamctl.models.comparison import OWN_PLANT, Comparison, ComparisonGap
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import MUTED, Plot, plot_apart
from pamctl.report.report import SIGNAL_DISPLAYS, Figure, Report, ReportTable, Section, Text
from pamctl.report.reported_run import ReportedRun
from pamctl.report.run_motion import make_time_axis, mark_moments

_UM, _KPA = 1e6, 1e-3
_Models = Mapping[str, Comparison]


def report_comparison(
    log: Log, found: _Models, map_path: Path | None = None, *, is_drawn: bool = False
) -> Report:
    """Return the gaps of every model to a log; with plots if `is_drawn`, of a whole log.

    `map_path` is the map by which a measured file was read.
    """
    path = log.path
    proposed = _suggest_next(path, found, map_path)
    comparisons = [*found.values()]
    measured = comparisons[0].measured
    coupled, alone = _draw_plots(log, found) if is_drawn else ([], [])
    report = Report(
        f"Model against {path.name}",
        f"{path}: {len(measured)} ticks from {measured.t_s[0]:.3f} s on, model minus measurement",
        subtitle=", ".join(found),
        document={**_make_document(path, found), "next": proposed},
    )
    report.add(Section("The gaps"), ReportTable(*list_gaps(found)).drop_empty())
    if coupled:
        caption = "The simulation with the logged command, and its gap."
        report.add(
            Section("The coupled model, driven by the logged command"), Figure(coupled, caption)
        )
    if alone:
        caption = (
            "Model minus measurement: the mechanics driven by the measured pressure or force, "
            "the pressure block by the command and the measured position."
        )
        report.add(
            Section("Each block alone, driven by the other's measured signal"),
            Figure(alone, caption),
        )
    for again_s in {c.again_s for c in comparisons} - {None}:
        report.add(
            Text(
                f"This axis forgets nothing: the model begins again every {again_s:g} s from the "
                "measured state, as in a diagnosis."
            )
        )
    if pauses := comparisons[0].pauses:
        where = "a pause" if pauses == 1 else f"each of {pauses} pauses"
        report.add(
            Text(
                f"The model begins again after {where} of the record, and knows nothing of what "
                f"was before: the {WARM_S:g} s after it count in no gap."
            )
        )
    said = dict.fromkeys(text for comparison in comparisons for text in comparison.unused)
    report.add(*map(Text, said))
    frozen = comparisons[0].frozen
    if frozen is not None:
        report.add(Text(f"A sensor is frozen at {int(frozen.sum())} ticks: they count in no gap."))
    return report.add(Text(f"next: `{proposed}`"))


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


def _suggest_next(path: Path, found: _Models, map_path: Path | None) -> str:
    closest = _find_closest(found)
    plant = [] if closest == OWN_PLANT else ["--plant", closest]
    words = [str(path), *(["--map", str(map_path)] if map_path else []), *plant]
    command = f"pamctl diagnose {shlex.join(words)} --out diagnosis"
    model = "this model, the closest," if len(found) > 1 else "the model"
    return f"{command}  # names what {model} lacks"


def _find_closest(found: _Models) -> str:
    """Return the plant with the smallest gaps, each as a share of the mean of all plants'."""
    each = [[c.gap(way, s).rms for way in c.all_ways for s in _BLOCKS] for c in found.values()]
    gaps = np.array(each)
    gaps = gaps[:, np.isfinite(gaps).all(0) & gaps.any(0)]  # which all plants have
    return [*found][int(np.argmin((gaps / gaps.mean(0)).sum(1)))]


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
            }
            for name, comparison in found.items()
        ],
    }


def _gap_fields(gap: ComparisonGap) -> dict[str, float | None]:
    return {name: None if value != value else value for name, value in gap._asdict().items()}


_BLOCKS = {
    "position_m": ("mechanics", "Mechanics alone"),
    "pressure_pa": ("pressure_block", "Pressure block alone"),
}
"""The block that makes each signal by itself, and the title of its gap."""


def _draw_plots(log: Log, found: _Models) -> tuple[list[Plot], list[Plot]]:
    """Draw every model beside the measurement, and the gap between them: coupled, and alone."""
    run = ReportedRun(log, log.path.stem)
    measured = next(iter(found.values())).measured
    t_s = measured.t_s - measured.t_s[0]
    axis = PlotAxis(make_time_axis([run]).label, "s", low=0.0, high=float(t_s[-1]), tight=True)
    colours = {name: colour for colour, name in enumerate(found)}

    def draw(signal: str, way: str, title: str, *, is_gap: bool = True) -> list[Plot]:
        """Draw a signal of all models as they are driven in one way, or its gap."""
        shown, real = SIGNAL_DISPLAYS[signal], getattr(measured, signal)
        factor = shown.gap_factor if is_gap else shown.factor
        y = PlotAxis("gap", shown.gap_unit) if is_gap else PlotAxis(shown.short, shown.unit)

        def draw_models(names: Sequence[str]) -> Plot:
            plot = Plot(title, axis, y, height_px=130 if is_gap else 180)
            if real is not None and not is_gap:
                plot.line(t_s, factor * real, "measured", colour=MUTED, thick=True)
            for name in names:
                modelled = getattr(found[name], way)
                model = getattr(modelled, signal) if modelled in found[name].ways else None
                if model is not None and not (is_gap and real is None):
                    drawn = model - real if is_gap else model
                    plot.line(t_s, factor * drawn, name, colour=colours[name])
            return plot

        return [plot for plot in plot_apart(draw_models, [*found]) if plot.marks]

    coupled: list[Plot] = []
    alone: list[Plot] = []
    has_coupled = any(len(one.ways) and one.ways[0] is one.coupled for one in found.values())
    for signal, (block, title) in _BLOCKS.items():
        alone += draw(signal, block, title)
        if has_coupled:
            name = SIGNAL_DISPLAYS[signal].title
            coupled += draw(signal, "coupled", name, is_gap=False)
            coupled += draw(signal, "coupled", f"{name}, model \N{MINUS SIGN} measurement")
    if coupled and measured.valve_v is not None:
        valve = Plot("Valve command", axis, PlotAxis("command", "V"), height_px=120)
        coupled.append(valve.line(t_s, measured.valve_v, step=True, colour=MUTED))
    mark_moments([*coupled, *alone], run.moments)
    return coupled, alone
