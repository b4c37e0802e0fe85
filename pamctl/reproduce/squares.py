"""Fig. 3: the model's answer to square waves of the valve command, open loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.reproduce.paper_cases import PLANTS, Case
from pamctl.simulate.closed_loop import SimulatedRun

FREQUENCIES = ("0.25", "0.5", "1", "2")
_ANY_LAW = Case("open loop", "paper-table3-qsmc")
"""No law acts in open loop, but the settings of a run need one."""


def write_fig3(page: Page, seed: int) -> dict[str, Any]:
    """Write Fig. 3; return ranges and rise times of the last cycle, by frequency and plant."""
    page.section("Fig. 3: square waves, open loop")
    page.text(
        "Full-scale squares of the command, ±5 V about the closed valve, on the model of "
        "Tables I and II, and with the valve's 109 Hz, which the paper states but does "
        "not simulate. The paper draws its measurement beside its model. Its curves are not "
        "published as numbers: only the model is shown here, and the comparison is by "
        "eye."
    )
    numbers: dict[str, Any] = {}
    plots: list[SvgPlot] = []
    for frequency in FREQUENCIES:
        runs = {plant: _ANY_LAW.run(f"square-{frequency}", plant, seed) for plant in PLANTS}
        plots += _make_plots(frequency, runs)
        numbers[frequency] = {
            plant: _measure_last_cycle(run, float(frequency)) for plant, run in runs.items()
        }
    page.grid(*plots, caption="Displacement and pressure at 0.25, 0.5, 1 and 2 Hz.")
    rows = [
        [f"{frequency} Hz, {PLANTS[plant]}", *_format_cells(found)]
        for frequency, of_plants in numbers.items()
        for plant, found in of_plants.items()
    ]
    page.table(
        ["last cycle", "mm, low", "high", "kPa, low", "high", "up, ms", "down, ms"],
        rows,
        caption="Displacement, absolute pressure, and the displacement's 10 to 90 % times.",
    )
    page.text(
        "The main reading: pressure in Eq. 3 to 6 is gauge pressure. With absolute "
        "pressure the vented muscle would rest at 11.6 mm, and could not reach the 6.4 mm of "
        "experiments 1 and 2. Friction is a band: it holds the muscle while the net force "
        "lies inside it."
    )
    return numbers


def _make_plots(frequency: str, runs: dict[str, SimulatedRun]) -> list[SvgPlot]:
    shown_s = 2.0 / float(frequency)
    time = PlotAxis("time", "s", tight=True)
    plots = []
    for what, column, scale, unit in (
        ("displacement", "true_position_m", 1e3, "mm"),
        ("pressure", "true_pressure_pa", 1e-3, "kPa"),
    ):
        plot = SvgPlot(f"{frequency} Hz, {what}", time, PlotAxis("", unit), height_px=130)
        for colour, (plant, run) in enumerate(runs.items()):
            seen = run.t_s < shown_s
            plot.line(run.t_s[seen], run[column][seen] * scale, PLANTS[plant], colour=colour)
        plots.append(plot)
    return plots


def _measure_last_cycle(run: SimulatedRun, frequency_hz: float) -> dict[str, float | None]:
    period_ticks = round(1000.0 / frequency_hz)
    half = period_ticks // 2
    t_s, x = run.t_s[-period_ticks:], run["true_position_m"][-period_ticks:]
    pressure = run["true_pressure_pa"][-period_ticks:]
    return {
        "position_low_m": float(x.min()),
        "position_high_m": float(x.max()),
        "pressure_low_pa": float(pressure.min()),
        "pressure_high_pa": float(pressure.max()),
        "rise_s": _measure_rise_time(t_s[:half], x[:half]),
        "fall_s": _measure_rise_time(t_s[half:], -x[half:]),
    }


def _measure_rise_time(t_s: np.ndarray, x: np.ndarray) -> float | None:
    """Return the time from 10 to 90 % of a rise; None if there is no rise."""
    low, high = float(x.min()), float(x.max())
    if high - low < 1e-6:
        return None
    share = (x - low) / (high - low)
    return float(t_s[np.argmax(share >= 0.9)] - t_s[np.argmax(share >= 0.1)])


def _format_cells(found: dict[str, float | None]) -> list[str]:
    scales = (1e3, 1e3, 1e-3, 1e-3, 1e3, 1e3)
    digits = (2, 2, 1, 1, 0, 0)
    return [
        "-" if value is None else f"{value * scale:.{places}f}"
        for value, scale, places in zip(found.values(), scales, digits, strict=True)
    ]
