"""Frequency responses of a run whose reference holds many frequencies, each with an interval.

A multisine repeats: its response is the mean over the periods, and the interval comes from how the
periods differ. A chirp does not: neighbouring lines of its spectrum are taken together, and the
interval comes from how far they are from one common response. In closed loop the command follows
the noise too. The plant's response is therefore the ratio of two responses to the reference, which
that noise biases less than the plain ratio of displacement to command.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from pamctl.control.experiment import ExperimentSettings, plan_experiment
from pamctl.control.forms import ChirpForm, MultisineForm
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import Plot
from pamctl.report.report import Figure, Report, Section, Text
from pamctl.report.reported_run import ReportedRun

Floats = NDArray[np.float64]
Spectrum = NDArray[np.complex128]

CONFIDENCE = 0.9
_FEWEST_LINES = 8
_BANDS_PER_OCTAVE = 6
_EXPERIMENT: TypeAdapter[Any] = TypeAdapter(ExperimentSettings)


@dataclass(frozen=True)
class FrequencyResponse:
    """Gain and phase from one signal to another; arrays of shape (n,)."""

    frequency_hz: Floats
    response: Spectrum
    """Output per input, in SI."""
    radius: Floats
    """The true response lies within this distance with a probability of 90 %; NaN if unknown."""
    coherence: Floats
    """Share of the output's power that follows the reference; 1 without noise."""

    @property
    def gain(self) -> Floats:
        """Magnitude of the response."""
        return np.abs(self.response)

    @property
    def phase_deg(self) -> Floats:
        """Phase without jumps of 360 degrees."""
        phase: Floats = np.rad2deg(np.unwrap(np.angle(self.response)))
        return phase

    @property
    def phase_radius_deg(self) -> Floats:
        """Half of the interval of the phase; 180 where the gain may be zero."""
        share = self.radius / self.gain
        half = np.rad2deg(np.arcsin(np.clip(share, 0.0, 1.0)))
        return np.where(share >= 1.0, 180.0, half)


class RunResponses(NamedTuple):
    """The responses of a run, and what its intervals come from."""

    closed_loop: FrequencyResponse | None
    """Displacement per reference; None in open loop."""
    plant: FrequencyResponse
    """Displacement per volt at the valve."""
    basis: str


def find_responses(run: ReportedRun) -> RunResponses | None:
    """Return the frequency responses of a multisine or a chirp.

    None for every other experiment, and for a run that ended within it.
    """
    try:
        form: object = _EXPERIMENT.validate_python(run.log.config.get("experiment"))
    except ValidationError:
        return None
    if not isinstance(form, MultisineForm | ChirpForm):
        return None
    begin_s, duration_s = _find_window_s(form)
    signals = _read_signals(run, form, begin_s, duration_s)
    if signals is None:
        return None
    if isinstance(form, MultisineForm):
        kept = form.periods - (form.periods >= _FEWEST_PERIODS_TO_DROP_ONE)
        lines = np.array(form.list_harmonics())
        frequency_hz = lines / form.period_s
        periods = [np.fft.rfft(s.reshape(form.periods, -1)[-kept:], axis=1) for s in signals]
        groups = [tuple(one[:, line] for one in periods) for line in lines]
        basis = f"intervals from {kept} periods" if kept > 1 else "one period gives no interval"
    else:
        # Each signal begins and ends at rest; a drift is taken off.
        whole = [np.fft.rfft(s - np.linspace(s[0], s[-1], len(s))) for s in signals]
        bands = list(_cut_bands(*_find_ends_hz(form), duration_s))
        if not bands:
            return None
        middle = [math.sqrt(band.start * (band.stop - 1)) for band in bands]
        frequency_hz = np.array(middle) / duration_s
        groups = [tuple(one[band] for one in whole) for band in bands]
        basis = f"intervals from {_FEWEST_LINES} or more lines of the spectrum at each point"
    return RunResponses(
        None if form.IS_VALVE else _join_groups(frequency_hz, [(a, a, x) for a, _, x in groups]),
        _join_groups(frequency_hz, groups),
        basis,
    )


_FEWEST_PERIODS_TO_DROP_ONE = 3
"""From so many on, the first period is left out: the loop settles in it."""


def _find_window_s(form: MultisineForm | ChirpForm) -> tuple[float, float]:
    """Return where the part that is judged begins, since the end of homing, and its length."""
    begins_s, now_s, spans = [], 0.0, []
    for segment in plan_experiment(form).segments:
        if segment.shape is not None:
            begins_s.append(now_s)
            spans.append(segment.duration_s)
        now_s += segment.duration_s
    if isinstance(form, MultisineForm):  # without the times in which it grows and decays
        return begins_s[1], spans[1]
    return begins_s[0], sum(spans)


def _read_signals(
    run: ReportedRun, form: MultisineForm | ChirpForm, begin_s: float, duration_s: float
) -> list[Floats] | None:
    """Return reference, valve and displacement on an even grid; None where the run ended within."""
    names = ("reference_valve_v" if form.IS_VALVE else "reference_m", "valve_v", "position_m")
    columns = [column for name in names if (column := run.column(name)) is not None]
    if len(columns) < len(names) or len(run) < 2:
        return None
    running = run.shown & np.isfinite(columns[0])
    t_s = run.t_s[running]
    if not len(t_s) or t_s[-1] < begin_s + duration_s - 0.01:
        return None
    step_s = float(np.median(np.diff(t_s)))
    count = round(duration_s / step_s)
    if isinstance(form, MultisineForm):  # whole periods
        count = round(form.period_s / step_s) * form.periods
    grid_s = begin_s + np.arange(count) * (duration_s / count)
    return [np.interp(grid_s, t_s, column[running]) for column in columns]


def _find_ends_hz(form: ChirpForm) -> tuple[float, float]:
    """Return the ends of what is judged: half of the time in which it is weak is left out."""
    wave, (grows_s, decays_s) = form.make_wave(), form.find_fades_s()
    begin_s, end_s = 0.5 * grows_s, form.duration_s - 0.5 * decays_s
    ends_hz = wave.frequency_at(begin_s), wave.frequency_at(end_s)
    return min(ends_hz), max(ends_hz)


def _cut_bands(low_hz: float, high_hz: float, duration_s: float) -> Iterator[slice]:
    """Yield ranges of lines, from low to high, that are a sixth of an octave wide or wider."""
    first, end = max(math.ceil(low_hz * duration_s), 1), math.floor(high_hz * duration_s) + 1
    while first < end:
        wide = math.ceil(first * 2 ** (1 / _BANDS_PER_OCTAVE))
        last = max(wide, first + _FEWEST_LINES)
        if end - last < _FEWEST_LINES:  # no narrow band is left at the top
            last = end
        if last - first >= _FEWEST_LINES:
            yield slice(first, last)
        first = last


def _join_groups(frequency_hz: Floats, groups: Sequence[tuple[Spectrum, ...]]) -> FrequencyResponse:
    """Return output per input at each frequency: a group holds reference, input and output.

    Their values, shape (lines,), are of one frequency in all periods, or of neighbouring lines.
    """
    found = [_join_lines(*group) for group in groups]
    response, radius, coherence = (np.array(column) for column in zip(*found, strict=True))
    return FrequencyResponse(frequency_hz, response, radius, coherence)


def _join_lines(
    asked: Spectrum, put_in: Spectrum, came_out: Spectrum
) -> tuple[complex, float, float]:
    """Return response, radius and coherence of the values of one group."""
    power = np.abs(asked) ** 2
    through = np.vdot(asked, put_in)
    response = complex(np.vdot(asked, came_out) / through)
    # Lines of unequal power count for fewer.
    lines = float(power.sum() ** 2 / (power**2).sum())
    if lines <= 1.5:
        return response, math.nan, math.nan
    apart = came_out - response * put_in
    variance = (
        float((power * np.abs(apart) ** 2).sum() / np.abs(through) ** 2) * lines / (lines - 1)
    )
    radius = math.sqrt(variance * _find_f_quantile(2.0 * (lines - 1.0)))
    return response, radius, min(_cohere(asked, came_out), _cohere(asked, put_in))


def _cohere(asked: Spectrum, came_out: Spectrum) -> float:
    powers = float((np.abs(asked) ** 2).sum() * (np.abs(came_out) ** 2).sum())
    return float(np.abs(np.vdot(asked, came_out)) ** 2 / max(powers, np.finfo(float).tiny))


def _find_f_quantile(freedom: float) -> float:
    """Return the quantile of the F distribution with 2 and `freedom` degrees of freedom."""
    return 0.5 * freedom * (math.pow(1.0 - CONFIDENCE, -2.0 / freedom) - 1.0)


_MM = 1e3


def write_frequency_response(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write gain, phase and coherence of closed loop and plant, where a run excites them."""
    found = [(run, responses) for run in runs if (responses := find_responses(run)) is not None]
    if not found:
        return
    page.add(Section("Frequency response"))
    closed = [(run.name, r.closed_loop, r) for run, r in found if r.closed_loop is not None]
    if closed:
        page.add(Section("Closed loop: displacement per reference", is_part=True))
        page.add(Figure([*_plot(closed, 1.0, "")], _make_caption(closed, _find_bandwidth)))
    plants = [(run.name, r.plant, r) for run, r in found]
    page.add(Section("Plant: displacement per volt at the valve", is_part=True))
    page.add(Figure([*_plot(plants, _MM, "mm/V")], _make_caption(plants, lambda curve: "")))
    page.add(
        Text(
            "The plant's response holds about this working point and for this amplitude: "
            "friction and valve are not linear. A multisine that repeats shows what noise adds; "
            "what the plant's curvature adds repeats too, and another amplitude or seed shows it."
        )
    )


_Curves = Sequence[tuple[str, FrequencyResponse, RunResponses]]


def _plot(curves: _Curves, scale: float, unit: str) -> list[Plot]:
    axis = PlotAxis("frequency", "Hz", log=True, tight=True)
    gain = Plot("Gain", axis, PlotAxis("gain", unit, log=True))
    phase = Plot("Phase", axis, PlotAxis("phase", "degrees"), height_px=140)
    coherence = Plot(
        "Coherence", axis, PlotAxis("coherence", "", low=0.0, high=1.02), height_px=100
    )
    for colour, (name, curve, _) in enumerate(curves):
        label = name if len(curves) > 1 else "measured, band: 90 % interval"
        f = curve.frequency_hz
        lowest = np.maximum(curve.gain - curve.radius, 0.1 * curve.gain)
        _draw_band(gain, f, scale * lowest, scale * (curve.gain + curve.radius), colour)
        gain.line(f, scale * curve.gain, label, colour=colour)
        half = curve.phase_radius_deg
        _draw_band(phase, f, curve.phase_deg - half, curve.phase_deg + half, colour)
        phase.line(f, curve.phase_deg, "", colour=colour)
        coherence.line(f, curve.coherence, "", colour=colour)
    return [gain, phase, coherence]


def _draw_band(plot: Plot, f: np.ndarray, low: np.ndarray, high: np.ndarray, colour: int) -> None:
    known = np.isfinite(low) & np.isfinite(high)
    if known.any():
        plot.band(f[known], low[known], high[known], colour=colour)


def _make_caption(curves: _Curves, find_bandwidth: Callable[[FrequencyResponse], str]) -> str:
    said = []
    for name, curve, responses in curves:
        whose = f"{name}: " if len(curves) > 1 else ""
        said.append(f"{whose}{find_bandwidth(curve)}{responses.basis}.")
    return " ".join(said)


def _find_bandwidth(curve: FrequencyResponse) -> str:
    """Say where the gain falls below -3 dB of the lowest frequency's, if it does."""
    below = np.flatnonzero(curve.gain < curve.gain[0] / np.sqrt(2.0))
    if not len(below):
        return ""
    return f"the gain is 3 dB below its first value from {curve.frequency_hz[below[0]]:.3g} Hz on; "
