"""The frequency response of runs that excite many frequencies."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.frequency_response import FrequencyResponse, RunResponses, find_responses
from pamctl.report.html_page import Page
from pamctl.report.reported_run import ReportedRun

_MM = 1e3


def write_frequency_response(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write gain, phase and coherence of closed loop and plant, where a run excites them."""
    found = [(run, responses) for run in runs if (responses := find_responses(run)) is not None]
    if not found:
        return
    page.section("Frequency response")
    closed = [(run.name, r.closed_loop, r) for run, r in found if r.closed_loop is not None]
    if closed:
        page.heading("Closed loop: displacement per reference")
        page.figure(*_plot(closed, 1.0, ""), caption=_make_caption(closed, _find_bandwidth))
    plants = [(run.name, r.plant, r) for run, r in found]
    page.heading("Plant: displacement per volt at the valve")
    page.figure(*_plot(plants, _MM, "mm/V"), caption=_make_caption(plants, lambda curve: ""))
    page.text(
        "The plant's response holds about this working point and for this amplitude: friction and "
        "valve are not linear. A multisine that repeats shows what noise adds; what the plant's "
        "curvature adds repeats too, and another amplitude or seed shows it."
    )


_Curves = Sequence[tuple[str, FrequencyResponse, RunResponses]]


def _plot(curves: _Curves, scale: float, unit: str) -> list[SvgPlot]:
    axis = PlotAxis("frequency", "Hz", log=True, tight=True)
    gain = SvgPlot("Gain", axis, PlotAxis("gain", unit, log=True))
    phase = SvgPlot("Phase", axis, PlotAxis("phase", "degrees"), height_px=140)
    coherence = SvgPlot(
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


def _draw_band(
    plot: SvgPlot, f: np.ndarray, low: np.ndarray, high: np.ndarray, colour: int
) -> None:
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
