"""Where model and measurement disagree: each block's residual over its working plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, Drive
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.locate import RATE, RegimeMisfit
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.report.compared_models import SIGNAL_DISPLAYS
from pamctl.diagnose.report.phrases import spell_regimes
from pamctl.diagnose.report.sensor_units import write_deviations
from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page

_FEWEST = 15
"""A cell of a map with fewer samples is left empty."""
_BRIGHT = 5.0
"""The brightest colour stands for at least this multiple of the floor, so that noise stays dark."""
_NAMES = {PRESSURE: "Pressure block", MECHANICS: "Mechanics"}


class WorkingPlane(NamedTuple):
    """Where a block was, sample by sample, and the grid of its map."""

    x: Array
    y: Array
    x_axis: PlotAxis
    y_axis: PlotAxis
    x_edges: Array
    y_edges: Array


def write_map(page: Page, diagnosis: Diagnosis) -> None:
    """Draw the maps before and after, then tabulate the regimes."""
    model, base = diagnosis.model, diagnosis.base
    if model is None or base is None:
        return
    blocks = sorted(model.evidence.blocks, key=base.ratio, reverse=True)
    page.section("Where they disagree")
    page.text(
        _describe_drive(diagnosis, blocks) + " The colour is the held-out residual over its floor: "
        "1 is nothing but noise. The floor is what the model leaves on data that it generated "
        "itself."
    )
    for block in blocks:
        page.grid(*_draw_maps(block, base, model), caption=_write_caption(block))
    page.table(*_tabulate_regimes(diagnosis, model, blocks))
    page.text(
        "Each regime is compared with the same regime of records that the model generated itself. "
        "A regime stands out if its excess is large enough to matter. On average at most "
        f"{100.0 * RATE:.0f} % of the regimes that stand out are noise (Benjamini and Hochberg)."
    )


def _write_caption(block: str) -> str:
    if block == PRESSURE:
        return "RMS of the pressure block's residual over command and pressure."
    return "RMS of the mechanics' residual over velocity and displacement."


def _draw_maps(block: str, base: Model, model: Model) -> list[SvgPlot]:
    """Return one map, or two with the same scale of colours."""
    plane = plane_of(model.evidence.holdout[block], model)
    labels = [(f"{_NAMES[block]}, recalibrated", base)]
    if model.effects:
        labels.append((f"{_NAMES[block]}, extended", model))
    grids = [
        np.sqrt(_cell_means(plane, m.residuals[block] ** 2)) / m.floors[block].mean
        for _, m in labels
    ]
    brightest = np.nanmax(grids[0], initial=_BRIGHT)
    return [
        SvgPlot(label, plane.x_axis, plane.y_axis).heat(
            plane.x_edges, plane.y_edges, grid, "x floor", low=0.0, high=float(brightest)
        )
        for (label, _), grid in zip(labels, grids, strict=True)
    ]


def write_shape(page: Page, diagnosis: Diagnosis) -> None:
    """Draw the mean residual with its sign: a description, never a cause."""
    model = diagnosis.model
    if model is None or model.is_complete:
        return
    for block in model.unexplained:
        plane = plane_of(model.evidence.holdout[block], model)
        first = model.evidence.holdout[block][0]
        display, deviation = SIGNAL_DISPLAYS[first.channel], first.deviation
        factor, unit = display.gap_factor, display.gap_unit
        grid = _cell_means(plane, model.residuals[block] * deviation * factor)
        widest = float(np.nanmax(np.abs(grid))) if np.isfinite(grid).any() else 1.0
        plot = SvgPlot(f"{_NAMES[block]}: unnamed correction", plane.x_axis, plane.y_axis)
        plot.heat(plane.x_edges, plane.y_edges, grid, unit, low=-widest, high=widest)
        page.figure(
            plot,
            caption="Mean of measurement \N{MINUS SIGN} simulation over the plane: what the "
            "simulated signal lacks there. This is an unnamed correction: it says how the model is "
            "wrong, not why. It holds for these excitations only.",
        )


def plane_of(drives: Sequence[Drive], model: Model) -> WorkingPlane:
    """Return the working plane of a block, over the counted samples of all its records."""
    p = model.evidence.nominal.parameters
    if drives[0].block == PRESSURE:
        x = np.concatenate([_select_counted(d, d.valve_v) for d in drives])
        gauge = [_select_counted(d, d.measured - p.atmospheric_pressure_pa) for d in drives]
        y = np.concatenate(gauge) * 1e-3
        axes = PlotAxis("valve command", "V"), PlotAxis("pressure, gauge", "kPa")
    else:
        x = np.concatenate([_select_counted(d, d.velocity_m_per_s) for d in drives]) * 1e3
        y = np.concatenate([_select_counted(d, d.position_m) for d in drives]) * 1e3
        axes = PlotAxis("velocity", "mm/s"), PlotAxis("displacement", "mm")
    return WorkingPlane(x, y, *axes, _cell_edges(x, 41), _cell_edges(y, 15))


def _select_counted(drive: Drive, values: Array) -> Array:
    return values if drive.rows is None else values[drive.rows]


def _cell_edges(values: Array, cells: int) -> Array:
    """Divide the usual range evenly; the few samples beyond it are not drawn."""
    low, high = np.quantile(values, [0.002, 0.998])
    if high <= low:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, cells + 1)


def _cell_means(plane: WorkingPlane, values: Array) -> Array:
    """Return the mean of every cell, shape (rows, columns); NaN where samples are few."""
    edges = (plane.y_edges, plane.x_edges)
    count = np.histogram2d(plane.y, plane.x, bins=edges)[0]
    total = np.histogram2d(plane.y, plane.x, bins=edges, weights=values)[0]
    means: Array = np.where(count >= _FEWEST, total / np.maximum(count, 1.0), np.nan)
    return means


def _describe_drive(diagnosis: Diagnosis, blocks: Sequence[str]) -> str:
    """Say what drives the simulated blocks."""
    if len(blocks) > 1:
        return (
            "Here each block is simulated alone, driven by the other's measured signal. A block "
            "without a fault stays dark, whatever the other block hides."
        )
    if blocks[0] == PRESSURE:
        return "The pressure is simulated, driven by the measured command."
    by = "force" if diagnosis.nominal.actuator == "direct" else "pressure"
    return f"The motion is simulated, driven by the measured {by}."


def _tabulate_regimes(
    diagnosis: Diagnosis, model: Model, blocks: Sequence[str]
) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: the regimes of all blocks, by their misfit before, largest first."""
    before, after = diagnosis.base_misfits, diagnosis.misfits
    later = {(c.block, c.regime): c for c in after}
    header = ["block", "regime", "of the time", "of the misfit", "recalibrated, x floor", "RMS"]
    if model.effects:
        header.append("extended, x floor")
    header.append("stands out")
    rows = []
    for cell in sorted(before, key=lambda c: (blocks.index(c.block), -c.residual_over_floor)):
        regime = spell_regimes(diagnosis, cell.regime)
        row = [cell.block, regime, f"{100.0 * cell.share:.0f} %"]
        row += [f"{100.0 * cell.excess_share:.0f} %", f"{cell.residual_over_floor:.2f}"]
        row.append(write_deviations(model, cell.block, cell.rms))
        last = later.get((cell.block, cell.regime)) if model.effects else None
        if model.effects:
            row.append(f"{last.residual_over_floor:.2f}" if last else "-")
        rows.append([*row, _describe_standing_out(cell, last)])
    return header, rows


def _describe_standing_out(before: RegimeMisfit, after: RegimeMisfit | None) -> str:
    still = after is not None and after.stands_out
    return {
        (True, True): "still",
        (True, False): "yes" if after is None else "no longer",
        (False, True): "now",
        (False, False): "",
    }[before.stands_out, still]
