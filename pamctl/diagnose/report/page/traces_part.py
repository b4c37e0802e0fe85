"""Measurement and models over time, on the held-out records."""

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
    simulate_stages,
)
from pamctl.report.drawing.svg import MUTED, PlotAxis, SvgPlot, plot_apart
from pamctl.report.html_page import Page
from pamctl.report.motion_section import mark_moments

STRETCH_S = 3.0
_TIME = PlotAxis("time", "s", tight=True)


class Stretch(NamedTuple):
    """A part of a held-out record: samples [start, stop)."""

    record: HeldOutRun
    start: int
    stop: int


def write_traces(page: Page, diagnosis: Diagnosis) -> None:
    """Show the most telling stretch, and the residual of its whole record."""
    records = simulate_stages(diagnosis)
    stages = list_model_stages(diagnosis)[-2:]
    if not records:
        return
    stretch = find_telling_stretch(records, stages)
    close_up = [*_draw_close_up(stretch, stages)]
    same_scale = [*_draw_same_scale(stretch, stages[-1])]
    whole = [*_draw_whole(stretch, stages)]
    mark_moments([*close_up, *same_scale, *whole], stretch.record.moments)
    page.section("Measured and simulated")
    page.figure(*close_up, caption=_write_caption(stretch, stages))
    page.figure(
        *same_scale,
        caption="The measured signal without its mean, and the residual, at the same scale: what "
        f'the model "{stages[-1].label}" leaves of what there was to explain.',
    )
    page.figure(
        *whole,
        caption=f"The residual over the whole record {stretch.record.name}. The stretch above lies "
        "between the dashed lines.",
    )


def find_telling_stretch(records: Sequence[HeldOutRun], stages: Sequence[ModelStage]) -> Stretch:
    """Return the stretch in which the last model improves most on the first.

    With a single model, return the stretch with the largest residual.
    """
    best, most = Stretch(records[0], 0, len(records[0].t_s)), -np.inf
    for record in records:
        length = min(int(np.searchsorted(record.t_s, STRETCH_S)), len(record.t_s))
        gains = _score_stretches(record, stages, length)
        start = int(np.argmax(gains))
        if gains[start] > most:
            best, most = Stretch(record, start, start + length), float(gains[start])
    return best


def _score_stretches(record: HeldOutRun, stages: Sequence[ModelStage], length: int) -> Array:
    """Return how much each stretch of `length` samples would show, in sensor deviations."""
    gains = np.zeros(len(record.t_s) - length + 1)
    for signal in record.signals:
        before, after = (
            _measure_movement(np.where(record.counted, signal.residual(s.key), 0.0), length)
            for s in (stages[0], stages[-1])
        )
        gains += (before - after if len(stages) > 1 else before) / signal.deviation**2
    return gains


def _measure_movement(residual: Array, length: int) -> Array:
    """Return how much a residual moves within each stretch; a constant one counts a tenth.

    A gap that opens and closes shows more than a constant one.
    """
    mean, square = (_moving_means(values, length) for values in (residual, residual**2))
    moving: Array = square - 0.9 * mean**2
    return moving


def _moving_means(values: Array, length: int) -> Array:
    sums = np.concatenate([[0.0], np.cumsum(values)])
    means: Array = (sums[length:] - sums[:-length]) / length
    return means


def _draw_close_up(stretch: Stretch, stages: Sequence[ModelStage]) -> Iterator[SvgPlot]:
    part = slice(stretch.start, stretch.stop)
    record = stretch.record
    t_s = record.t_s[part]
    for signal in record.signals:
        display = SIGNAL_DISPLAYS[signal.name]
        plot = SvgPlot(
            display.title, _TIME, PlotAxis(display.title.split(",")[0].lower(), display.unit)
        )
        plot.line(t_s, display.factor * signal.measured[part], "measured", colour=MUTED, thick=True)
        for stage in stages:
            simulated = display.factor * signal.simulated[stage.key][part]
            plot.line(t_s, simulated, stage.label, colour=stage.colour)
        yield plot
        yield from _draw_residual(t_s, signal, stages, part)
    if record.command_v is not None:
        command = SvgPlot("Valve command", _TIME, PlotAxis("command", "V"), height_px=90)
        yield command.line(t_s, record.command_v[part], step=True, colour=MUTED)


def _draw_residual(
    t_s: Array, signal: HeldOutSignal, stages: Sequence[ModelStage], part: slice
) -> list[SvgPlot]:
    display = SIGNAL_DISPLAYS[signal.name]
    title = f"{display.title.split(',')[0]}, measurement \N{MINUS SIGN} simulation"
    residuals = {stage.key: signal.residual(stage.key)[part] for stage in stages}
    factor, unit = display.choose_unit(max(float(np.abs(r).max()) for r in residuals.values()))

    def draw(shown: Sequence[ModelStage]) -> SvgPlot:
        plot = SvgPlot(title, _TIME, PlotAxis("residual", unit), height_px=110)
        for stage in shown:
            plot.line(t_s, factor * residuals[stage.key], stage.label, colour=stage.colour)
        return plot

    return plot_apart(draw, stages)


def _draw_same_scale(stretch: Stretch, stage: ModelStage) -> Iterator[SvgPlot]:
    """Draw signal and residual of the whole record on one axis, with their RMS as labels."""
    record = stretch.record
    for signal in record.signals:
        display = SIGNAL_DISPLAYS[signal.name]
        moved = display.factor * (signal.measured - np.mean(signal.measured))
        left = display.factor * signal.residual(stage.key)
        name = display.title.split(",")[0]
        plot = SvgPlot(f"{name}, signal and residual", _TIME, PlotAxis(name.lower(), display.unit))
        for label, values, colour in (("signal", moved, MUTED), ("residual", left, stage.colour)):
            rms = float(np.sqrt(np.mean(values[record.counted] ** 2)))
            plot.line(record.t_s, values, f"{label}, RMS {rms:.3g} {display.unit}", colour=colour)
        yield plot


def _draw_whole(stretch: Stretch, stages: Sequence[ModelStage]) -> Iterator[SvgPlot]:
    t_s = stretch.record.t_s
    for signal in stretch.record.signals:
        for plot in _draw_residual(t_s, signal, stages, slice(None)):
            plot.place(float(t_s[stretch.start]), "")
            yield plot.place(float(t_s[stretch.stop - 1]), "")


def _write_caption(stretch: Stretch, stages: Sequence[ModelStage]) -> str:
    why = (
        f'where the model "{stages[-1].label}" improves most on "{stages[-2].label}"'
        if len(stages) > 1
        else "where the residual is largest"
    )
    return f"{STRETCH_S:g} s of the held-out record {stretch.record.name}, {why}."
