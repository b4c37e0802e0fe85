"""Measurement and models over time, on records that nothing was fitted to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.report.compared_models import SHOWN, HeldOut, Signal, Stage, held_out, stages
from pamctl.report.html_page import Page
from pamctl.report.svg import MUTED, Axis, Plot

STRETCH_S = 3.0
_TIME = Axis("time", "s", tight=True)


class Stretch(NamedTuple):
    """A part of a held-out record: samples [start, stop)."""

    record: HeldOut
    start: int
    stop: int


def write_traces(page: Page, diagnosis: Diagnosis) -> None:
    """Show the most telling stretch, and the residual of the whole record around it."""
    records = held_out(diagnosis)
    shown = stages(diagnosis)[-2:]
    if not records:
        return
    found = most_telling(records, shown)
    page.section("Measured and simulated")
    page.figure(*_close(found, shown), caption=_told(found, shown))
    page.figure(
        *_whole(found.record, shown, found),
        caption=f"The residual over the whole of {found.record.name}; between the dashed lines is "
        "the stretch above.",
    )


def most_telling(records: Sequence[HeldOut], shown: Sequence[Stage]) -> Stretch:
    """Return the stretch in which the last model gains most on the one before it.

    Where they do as well as each other, or there is one only, where its residual is largest.
    """
    best, most = Stretch(records[0], 0, len(records[0].t_s)), -np.inf
    for record in records:
        length = min(int(np.searchsorted(record.t_s, STRETCH_S)), len(record.t_s))
        gains = _gains(record, shown, length)
        start = int(np.argmax(gains))
        if gains[start] > most:
            best, most = Stretch(record, start, start + length), float(gains[start])
    return best


def _gains(record: HeldOut, shown: Sequence[Stage], length: int) -> Array:
    """What each stretch of so many samples would show, counted in deviations of the sensors."""
    gains = np.zeros(len(record.t_s) - length + 1)
    for signal in record.signals:
        before, after = (
            _movement(np.where(record.counted, signal.residual(s.key), 0.0), length)
            for s in (shown[0], shown[-1])
        )
        gains += (before - after if len(shown) > 1 else before) / signal.deviation**2
    return gains


def _movement(residual: Array, length: int) -> Array:
    """How much a residual moves within each stretch; a constant one counts a tenth.

    Where a gap opens and closes more is to be seen than where it stands.
    """
    mean, square = (_means(values, length) for values in (residual, residual**2))
    moving: Array = square - 0.9 * mean**2
    return moving


def _means(values: Array, length: int) -> Array:
    sums = np.concatenate([[0.0], np.cumsum(values)])
    means: Array = (sums[length:] - sums[:-length]) / length
    return means


def _close(found: Stretch, shown: Sequence[Stage]) -> Iterator[Plot]:
    part = slice(found.start, found.stop)
    t_s = found.record.t_s[part]
    for signal in found.record.signals:
        how = SHOWN[signal.name]
        plot = Plot(how.title, _TIME, Axis(how.title.split(",")[0].lower(), how.unit))
        plot.line(t_s, how.factor * signal.measured[part], "measured", colour=MUTED, thick=True)
        for stage in shown:
            simulated = how.factor * signal.simulated[stage.key][part]
            plot.line(t_s, simulated, stage.label, colour=stage.colour)
        yield plot
        yield _residual(t_s, signal, shown, part)
    if found.record.command_v is not None:
        command = Plot("Valve command", _TIME, Axis("command", "V"), height_px=90)
        yield command.line(t_s, found.record.command_v[part], step=True, colour=MUTED)


def _residual(t_s: Array, signal: Signal, shown: Sequence[Stage], part: slice) -> Plot:
    how = SHOWN[signal.name]
    title = f"{how.title.split(',')[0]}, measurement \N{MINUS SIGN} simulation"
    plot = Plot(title, _TIME, Axis("residual", how.gap_unit), height_px=110)
    for stage in shown:
        residual = how.gap_factor * signal.residual(stage.key)[part]
        plot.line(t_s, residual, stage.label, colour=stage.colour)
    return plot


def _whole(record: HeldOut, shown: Sequence[Stage], found: Stretch) -> Iterator[Plot]:
    for signal in record.signals:
        plot = _residual(record.t_s, signal, shown, slice(None))
        plot.place(float(record.t_s[found.start]), "")
        yield plot.place(float(record.t_s[found.stop - 1]), "")


def _told(found: Stretch, shown: Sequence[Stage]) -> str:
    why = (
        f"where the model {shown[-1].label} gains most on the model {shown[-2].label}"
        if len(shown) > 1
        else "where the residual is largest"
    )
    return f"{STRETCH_S:g} s of the held-out record {found.record.name}, {why}."
