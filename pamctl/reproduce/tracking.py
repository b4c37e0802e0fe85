"""Fig. 4 and 5: experiments 1 and 2 with the printed and with tuned gains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pamctl.report.drawing.svg import MUTED, PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.reproduce.paper_cases import FITTED_SMC, PRINTED_QSMC, PRINTED_SMC, TUNED, Case
from pamctl.signals import Phase
from pamctl.simulate.closed_loop import SimulatedRun

FIGURES = {
    "fig4": ("tracking-1", "Fig. 4: experiment 1"),
    "fig5": ("tracking-2", "Fig. 5: experiment 2"),
}


def write_tracking(page: Page, figure: str, seed: int) -> dict[str, Any]:
    """Write Fig. 4 or 5; return the runs' figures of merit by case."""
    experiment, heading = FIGURES[figure]
    page.section(heading)
    page.text(
        "Reference, both laws, their errors, commands and the pressure, on the model of "
        "Tables I and II. The approach from the vented muscle is left out."
    )
    qsmc, smc, *_ = TUNED
    page.heading("With the gains that the paper prints")
    page.figure(
        *_plot_stack((PRINTED_QSMC, FITTED_SMC), experiment, seed),
        caption="qSMC as printed, and SMC as printed except K_p, which was fitted to Table IV.",
    )
    _write_literal_smc(page, experiment, seed)
    page.heading("With tuned gains")
    page.figure(
        *_plot_stack((qsmc, smc), experiment, seed),
        caption="qSMC and SMC, tuned with equal effort.",
    )
    cases = (PRINTED_QSMC, PRINTED_SMC, FITTED_SMC, qsmc, smc)
    return {case.name: summarise_outcome(case.run(experiment, "paper", seed)) for case in cases}


def summarise_outcome(run: SimulatedRun) -> dict[str, float | None]:
    """Return the figures of merit in m, None if there are none, and the time of a trip."""
    found = run.merit()
    figures: dict[str, float | None] = dict.fromkeys(("max_m", "rms_m", "steady_m"))
    if found is not None:
        figures = {name: None if np.isnan(v) else v for name, v in found._asdict().items()}
    return {**figures, "tripped_s": run.tripped_s}


def _write_literal_smc(page: Page, experiment: str, seed: int) -> None:
    run = PRINTED_SMC.run(experiment, "paper", seed)
    if run.tripped_s is None:
        return
    page.note(
        f"SMC with the printed gains does not move the muscle: its command stays within "
        f"{np.abs(run['command_v']).max() * 1e3:.2g} mV, and safety ends the run after "
        f"{run.tripped_s:.2f} s, still in the approach, because the error exceeds its limit.",
        kind="bad",
    )


def _plot_stack(cases: Sequence[Case], experiment: str, seed: int) -> list[SvgPlot]:
    time = PlotAxis("time since the end of the approach", "s", tight=True)
    position = SvgPlot("Displacement", time, PlotAxis("displacement", "mm"), height_px=160)
    error = SvgPlot("Error", time, PlotAxis("x \N{MINUS SIGN} x_D", "µm"), height_px=130)
    command = SvgPlot("Command", time, PlotAxis("u", "V"), height_px=110)
    pressure = SvgPlot("Pressure", time, PlotAxis("absolute", "kPa"), height_px=110)
    for colour, case in enumerate(cases):
        run = case.run(experiment, "paper", seed)
        shown = np.isin(run["phase"], (Phase.TRACK, Phase.REST))
        if not shown.any():
            continue
        t_s = run.t_s[shown] - run.t_s[shown][0]
        if not colour:
            reference_mm = run["reference_m"][shown] * 1e3
            position.line(t_s, reference_mm, "reference", colour=MUTED, thick=True)
        position.line(t_s, run["position_m"][shown] * 1e3, case.name, colour=colour)
        error.line(t_s, run.error_m[shown] * 1e6, case.name, colour=colour)
        command.line(t_s, run["command_v"][shown], case.name, colour=colour)
        pressure.line(t_s, run["true_pressure_pa"][shown] * 1e-3, case.name, colour=colour)
    return [position, error, command, pressure]
