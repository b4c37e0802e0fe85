"""Measurement and models over time, on records that nothing was fitted to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.report.compared_models import (
    SIGNAL_DISPLAYS,
    HeldOutRun,
    HeldOutSignal,
    ModelStage,
    list_model_stages,
    simulate_held_out,
)
from pamctl.report.drawing.svg import MUTED, PlotAxis, SvgPlot
from pamctl.report.html_page import Page

STRETCH_S = 3.0
_TIME = PlotAxis("time", "s", tight=True)


class Stretch(NamedTuple):
    """A part of a held-out record: samples [start, stop)."""

    record: HeldOutRun
    start: int
    stop: int


def write_traces(page: Page, diagnosis: Diagnosis) -> None:
    """Show the most telling stretch, and the residual of the whole record around it."""
    records = simulate_held_out(diagnosis)
    shown = list_model_stages(diagnosis)[-2:]
    if not records:
        return
    found = find_telling_stretch(records, shown)
    page.section("Measured and simulated")
    page.figure(*_draw_close_up(found, shown), caption=_write_caption(found, shown))
    page.figure(
        *_draw_whole(found.record, shown, found),
        caption=f"The residual over the whole of {found.record.name}; between the dashed lines is "
        "the stretch above.",
    )


def find_telling_stretch(records: Sequence[HeldOutRun], shown: Sequence[ModelStage]) -> Stretch:
    """Return the stretch in which the last model gains most on the one before it.

    Where they do as well as each other, or there is one only, where its residual is largest.
    """
    best, most = Stretch(records[0], 0, len(records[0].t_s)), -np.inf
    for record in records:
        length = min(int(np.searchsorted(record.t_s, STRETCH_S)), len(record.t_s))
        gains = _score_stretches(record, shown, length)
        start = int(np.argmax(gains))
        if gains[start] > most:
            best, most = Stretch(record, start, start + length), float(gains[start])
    return best


def _score_stretches(record: HeldOutRun, shown: Sequence[ModelStage], length: int) -> Array:
    """What each stretch of so many samples would show, counted in deviations of the sensors."""
    gains = np.zeros(len(record.t_s) - length + 1)
    for signal in record.signals:
        before, after = (
            _measure_movement(np.where(record.counted, signal.residual(s.key), 0.0), length)
            for s in (shown[0], shown[-1])
        )
        gains += (before - after if len(shown) > 1 else before) / signal.deviation**2
    return gains


def _measure_movement(residual: Array, length: int) -> Array:
    """How much a residual moves within each stretch; a constant one counts a tenth.

    Where a gap opens and closes more is to be seen than where it stands.
    """
    mean, square = (_moving_means(values, length) for values in (residual, residual**2))
    moving: Array = square - 0.9 * mean**2
    return moving


def _moving_means(values: Array, length: int) -> Array:
    sums = np.concatenate([[0.0], np.cumsum(values)])
    means: Array = (sums[length:] - sums[:-length]) / length
    return means


def _draw_close_up(found: Stretch, shown: Sequence[ModelStage]) -> Iterator[SvgPlot]:
    part = slice(found.start, found.stop)
    t_s = found.record.t_s[part]
    for signal in found.record.signals:
        how = SIGNAL_DISPLAYS[signal.name]
        plot = SvgPlot(how.title, _TIME, PlotAxis(how.title.split(",")[0].lower(), how.unit))
        plot.line(t_s, how.factor * signal.measured[part], "measured", colour=MUTED, thick=True)
        for stage in shown:
            simulated = how.factor * signal.simulated[stage.key][part]
            plot.line(t_s, simulated, stage.label, colour=stage.colour)
        yield plot
        yield _draw_residual(t_s, signal, shown, part)
    if found.record.command_v is not None:
        command = SvgPlot("Valve command", _TIME, PlotAxis("command", "V"), height_px=90)
        yield command.line(t_s, found.record.command_v[part], step=True, colour=MUTED)


def _draw_residual(
    t_s: Array, signal: HeldOutSignal, shown: Sequence[ModelStage], part: slice
) -> SvgPlot:
    how = SIGNAL_DISPLAYS[signal.name]
    title = f"{how.title.split(',')[0]}, measurement \N{MINUS SIGN} simulation"
    plot = SvgPlot(title, _TIME, PlotAxis("residual", how.gap_unit), height_px=110)
    for stage in shown:
        residual = how.gap_factor * signal.residual(stage.key)[part]
        plot.line(t_s, residual, stage.label, colour=stage.colour)
    return plot


def _draw_whole(
    record: HeldOutRun, shown: Sequence[ModelStage], found: Stretch
) -> Iterator[SvgPlot]:
    for signal in record.signals:
        plot = _draw_residual(record.t_s, signal, shown, slice(None))
        plot.place(float(record.t_s[found.start]), "")
        yield plot.place(float(record.t_s[found.stop - 1]), "")


def _write_caption(found: Stretch, shown: Sequence[ModelStage]) -> str:
    why = (
        f"where the model {shown[-1].label} gains most on the model {shown[-2].label}"
        if len(shown) > 1
        else "where the residual is largest"
    )
    return f"{STRETCH_S:g} s of the held-out record {found.record.name}, {why}."
