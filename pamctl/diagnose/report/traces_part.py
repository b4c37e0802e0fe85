"""Measurement and models over time, on the records that judge; and what is left over the time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pamctl.diagnose.diagnosis import Diagnosis, Verdict
from pamctl.diagnose.evidence.fit import WeighedModel
from pamctl.diagnose.record import Array
from pamctl.log.run_meta import Moment
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import MUTED, Plot, plot_apart
from pamctl.report.report import SIGNAL_DISPLAYS, Figure, Report, Section, spell_figure
from pamctl.report.run_motion import mark_moments

STRETCH_S = 3.0
MOST_NOISE = 1e4
"""A model that runs away is drawn so many times the sensor's noise away."""
_TIME = PlotAxis("time", "s", tight=True)


class ModelStage(NamedTuple):
    """One of the models between the start model and the model to go on with."""

    key: str
    """The name of its level in a `HeldOutGap`."""
    label: str
    model: WeighedModel
    colour: int


@dataclass(frozen=True)
class ShownRun:
    """A record, or the part of one between gaps, with its simulations; arrays (channels, n), SI."""

    name: str
    t_s: Array
    command_v: Array | None
    channels: tuple[str, ...]
    measured: Array
    residuals: dict[str, Array]
    """Measured minus simulated by stage."""
    counted: Array
    """1 where a sample counts, NaN where not."""
    noise: Array
    units: tuple[tuple[float, str], ...]
    """Of each channel, the factor and unit of a residual."""
    moments: tuple[Moment, ...] = ()


def list_stages(diagnosis: Diagnosis) -> list[ModelStage]:
    """Return the models that this verdict compares; the last one is the model to go on with."""
    evidence = diagnosis.evidence
    if evidence is None:
        return []
    stages = [ModelStage("nominal", "start model", evidence.start, 3)]
    if diagnosis.verdict is not Verdict.NO_DISCREPANCY:
        stages.append(ModelStage("recalibrated", "recalibrated", evidence.base, 1))
    if diagnosis.findings:
        stages.append(ModelStage("extended", "with what was found", evidence.model, 0))
    return stages


def show_runs(diagnosis: Diagnosis, stages: Sequence[ModelStage]) -> list[ShownRun]:
    """Simulate every stage on the held-out records, or on the fitted ones if none are held out."""
    evidence = diagnosis.evidence
    if evidence is None or not stages:
        return []
    weigher = evidence.weigher
    runs = weigher.held_out or weigher.train
    noise = np.array([evidence.noise_rms[c] for c in runs.channels])
    most = MOST_NOISE * noise[:, None]
    shown: Array = runs.shown.reshape(len(runs.channels), -1)
    counted, left = np.where(runs.masked.reshape(shown.shape), np.nan, 1.0), {}
    for s in stages:
        rows = runs.simulate({**weigher.base, **s.model.values}, min(runs.steps_s))
        left[s.key] = np.clip(shown - rows.reshape(shown.shape), -most, most)
    when_s, at, found = runs.when_s.ravel(), 0, []
    units = tuple(SIGNAL_DISPLAYS[c].choose_unit(max(diagnosis.gap[c][:3])) for c in runs.channels)
    moments = {r.name: r.moments for r in (*diagnosis.train, *diagnosis.holdout)}
    for piece, size in zip(runs.stretches, runs.sizes, strict=True):
        n = min(size, piece.shown.shape[1])
        part = slice(at, at + n)
        command = piece.inputs.get("valve_v")
        found.append(
            ShownRun(
                piece.name, piece.begin_s + when_s[part], None if command is None else command[:n],
                runs.channels, shown[:, part], {k: rows[:, part] for k, rows in left.items()},
                counted[:, part], noise, units, moments.get(piece.name, ()),
            )
        )  # fmt: skip
        at += size
    return found


def write_traces(page: Report, diagnosis: Diagnosis) -> None:
    """Show the most telling stretch, and the residual of its whole record."""
    stages = list_stages(diagnosis)
    runs = show_runs(diagnosis, stages)
    if not runs:
        return
    stages = stages[-2:]
    run, part = find_telling_stretch(runs, stages)
    close_up = [*_draw_close_up(run, part, stages)]
    same_scale = [*_draw_same_scale(run, stages[-1])]
    is_part = part.stop - part.start < len(run.t_s)
    whole = [*_draw_whole(run, part, stages)] if is_part else []
    mark_moments([*close_up, *same_scale, *whole], run.moments)
    page.add(Section("Measured and simulated"))
    why = (
        f'where the model "{stages[-1].label}" improves most on "{stages[-2].label}"'
        if len(stages) > 1
        else "where the residual is largest"
    )
    use = "held-out" if diagnosis.holdout else "partly fitted"
    is_windowed = diagnosis.evidence is not None and diagnosis.evidence.weigher.train.windowed
    jumps = ", and jumps where a window begins anew from the readings" if is_windowed else ""
    page.add(
        Figure(
            [*close_up],
            f"The {use} record {run.name}, at most {STRETCH_S:g} s of it, {why}. A residual "
            f"breaks where samples do not count{jumps}.",
        )
    )
    page.add(
        Figure(
            [*same_scale],
            "The measured signal without its mean, and the residual, at the same scale: what "
            f'the model "{stages[-1].label}" leaves of what there was to explain.',
        )
    )
    if whole:
        page.add(
            Figure(
                [*whole],
                f"What is left over the whole record {run.name}. The stretch above lies "
                "between the dashed lines.",
            )
        )


def find_telling_stretch(
    runs: Sequence[ShownRun], stages: Sequence[ModelStage]
) -> tuple[ShownRun, slice]:
    """Return the stretch in which the last model improves most on the first.

    With a single model, return the stretch with the largest residual.
    """
    best, most = (runs[0], slice(0, len(runs[0].t_s))), -np.inf
    for run in runs:
        length = min(int(np.searchsorted(run.t_s - run.t_s[0], STRETCH_S)), len(run.t_s))
        gains = np.zeros(len(run.t_s) - length + 1)
        for c, noise in enumerate(run.noise):
            before, after = (
                _measure_movement(np.nan_to_num(run.residuals[s.key][c] * run.counted[c]), length)
                for s in (stages[0], stages[-1])
            )
            gains += (before - after if len(stages) > 1 else before) / noise**2
        begin = int(np.argmax(gains))
        if gains[begin] > most:
            best, most = (run, slice(begin, begin + length)), float(gains[begin])
    return best


def _measure_movement(residual: Array, length: int) -> Array:
    """Return how much a residual moves within each stretch; a constant one counts a tenth.

    A gap that opens and closes shows more than a constant one.
    """
    means = []
    for values in (residual, residual**2):
        sums = np.concatenate([[0.0], np.cumsum(values)])
        means.append((sums[length:] - sums[:-length]) / length)
    return np.asarray(means[1] - 0.9 * means[0] ** 2)


def _draw_close_up(run: ShownRun, part: slice, stages: Sequence[ModelStage]) -> Iterator[Plot]:
    t_s = run.t_s[part]
    for c, channel in enumerate(run.channels):
        display = SIGNAL_DISPLAYS[channel]
        plot = Plot(display.title, _TIME, PlotAxis(display.short, display.unit))
        measured = run.measured[c, part]
        plot.line(t_s, display.factor * measured, "measured", colour=MUTED, thick=True)
        for stage in stages:
            simulated = display.factor * (measured - run.residuals[stage.key][c, part])
            plot.line(t_s, simulated, stage.label, colour=stage.colour)
        yield plot
        yield from _draw_residual(run, c, stages, part)
    if run.command_v is not None:
        command = Plot("Valve command", _TIME, PlotAxis("command", "V"), height_px=90)
        yield command.line(t_s, run.command_v[part], step=True, colour=MUTED)


def _draw_residual(run: ShownRun, c: int, stages: Sequence[ModelStage], part: slice) -> list[Plot]:
    display = SIGNAL_DISPLAYS[run.channels[c]]
    title = f"{display.title.split(',')[0]}, measurement \N{MINUS SIGN} simulation"
    residuals = {s.key: (run.residuals[s.key] * run.counted)[c, part] for s in stages}
    factor, unit = run.units[c]

    def draw(shown: Sequence[ModelStage]) -> Plot:
        plot = Plot(title, _TIME, PlotAxis("residual", unit), height_px=110)
        for stage in shown:
            plot.line(
                run.t_s[part], factor * residuals[stage.key], stage.label, colour=stage.colour
            )
        return plot

    return plot_apart(draw, stages)


def _draw_same_scale(run: ShownRun, stage: ModelStage) -> Iterator[Plot]:
    """Draw signal and residual of the whole record on one axis, with their RMS as labels."""
    for c, channel in enumerate(run.channels):
        display = SIGNAL_DISPLAYS[channel]
        moved = run.measured[c] - np.mean(run.measured[c])
        left = run.residuals[stage.key][c] * run.counted[c]
        plot = Plot(
            f"{display.title.split(',')[0]}, signal and residual", _TIME,
            PlotAxis(display.short, display.unit),
        )  # fmt: skip
        of_signal, of_residual = (display.factor, display.unit), run.units[c]
        for label, values, colour, (factor, unit) in (
            ("signal", moved, MUTED, of_signal),
            ("residual", left, stage.colour, of_residual),
        ):
            kept = values[np.isfinite(values)]
            rms = factor * float(np.sqrt(np.mean(kept**2))) if len(kept) else 0.0
            name = f"{label}, RMS {spell_figure(rms)} {unit}"
            plot.line(run.t_s, display.factor * values, name, colour=colour)
        yield plot


def _draw_whole(run: ShownRun, part: slice, stages: Sequence[ModelStage]) -> Iterator[Plot]:
    for c in range(len(run.channels)):
        for plot in _draw_residual(run, c, stages, slice(None)):
            plot.place(float(run.t_s[part.start]), "")
            yield plot.place(float(run.t_s[part.stop - 1]), "")
