"""`pamctl reproduce`: the paper's figures and table from this software, on one page.

paper_cases -> Fig. 3: squares, Fig. 4 and 5: tracking, Table IV -> page and numbers
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from pamctl import __version__
from pamctl.control.law_registry import find_law
from pamctl.offline.closed_loop import SimulatedRun, simulate_run
from pamctl.offline.merit import NO_MERIT, find_paper_rows
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import MUTED, Plot
from pamctl.report.report import (
    Figure,
    Points,
    Report,
    ReportTable,
    Section,
    Text,
    spell_um,
)
from pamctl.settings.resolve import RunSettings, resolve
from pamctl.signals import Phase

PLANTS = {"paper": "of Tables I and II", "paper-valve109": "with the valve's 109 Hz"}
"""Shipped plants on which the reproduction runs."""


@dataclass(frozen=True)
class Case:
    """A law with its gains."""

    name: str
    controller: str
    overrides: tuple[str, ...] = ()
    remark: str = ""

    def resolve(self, experiment: str, plant: str, seed: int) -> RunSettings:
        """Return the settings of a run with it."""
        return resolve(
            controller=self.controller,
            experiment=experiment,
            plant=plant,
            overrides=self.overrides,
            seed=seed,
        )

    @lru_cache(maxsize=64)  # noqa: B019  (cases are few, and last as long as the program)
    def run(self, experiment: str, plant: str, seed: int) -> SimulatedRun:
        """Simulate it, once."""
        return simulate_run(self.resolve(experiment, plant, seed))

    def summarise(self, experiment: str, plant: str, seed: int) -> dict[str, float | None]:
        """Return the errors of a run in m, None if there are none, and the time of a trip."""
        run = self.run(experiment, plant, seed)
        return {**(run.merit() or NO_MERIT).as_dict(), "tripped_s": run.tripped_s}


PRINTED_QSMC = Case("qSMC as printed", "paper-table3-qsmc", remark="Table III literally, in inches")
IN_MILLIMETRES = Case(
    "qSMC as printed, in mm",
    "paper-table3-qsmc",
    ("controller.length_unit=mm", "controller.eta=10.2", "controller.phi=0.51"),
    "the same numbers with e in millimetres: Eq. 15 is not homogeneous, so it is another law",
)
PRINTED_SMC = Case("SMC as printed", "paper-table3-smc", remark="Table III literally, in inches")
UNHINDERED_SMC = Case(
    "SMC as printed, no limit",
    "paper-table3-smc",
    ("rig.limits.tracking_error_mm=100",),
    "the same with the limit on the tracking error lifted",
)
FITTED_SMC = Case(
    "SMC, K_p fitted",
    "paper-table3-smc",
    ("controller.kp=0.65",),
    "as printed, but K_p is 0.65 instead of 0.00025: fitted to Table IV, so it confirms nothing",
)
TUNED = (
    Case("qSMC tuned", "qsmc", remark="the default: one set for all plants"),
    Case("SMC tuned", "smc", remark="one set for all plants"),
    Case("PID tuned", "pid", remark="one set for all plants"),
    Case("qSMC for this plant", "qsmc-paper-plant", remark="tuned for the paper's plant alone"),
    Case("SMC for this plant", "smc-paper-plant", remark="tuned for the paper's plant alone"),
    Case("PID for this plant", "pid-paper-plant", remark="tuned for the paper's plant alone"),
)
ALL = (PRINTED_QSMC, IN_MILLIMETRES, PRINTED_SMC, UNHINDERED_SMC, FITTED_SMC, *TUNED)


FREQUENCIES = ("0.25", "0.5", "1", "2")
_ANY_LAW = Case("open loop", "paper-table3-qsmc")
"""No law acts in open loop, but the settings of a run need one."""


def write_fig3(page: Report, seed: int) -> dict[str, Any]:
    """Write Fig. 3; return ranges and rise times of the last cycle, by frequency and plant."""
    page.add(Section("Fig. 3: square waves, open loop"))
    page.add(
        Text(
            "Full-scale squares of the command, ±5 V about the closed valve. The paper's curves "
            "are not published as numbers: only the model is shown here, and the comparison is by "
            "eye."
        )
    )
    numbers: dict[str, Any] = {}
    plots: list[Plot] = []
    rows = []
    for frequency in FREQUENCIES:
        runs = {plant: _ANY_LAW.run(f"square-{frequency}", plant, seed) for plant in PLANTS}
        plots += _make_plots(frequency, runs)
        found = {plant: _measure_last_cycle(run, float(frequency)) for plant, run in runs.items()}
        numbers[frequency] = found
        for plant, measured in found.items():
            cells = zip(measured.values(), _FORMATS, strict=True)
            shown = [
                "-" if v is None else f"{v * scale:.{digits}f}" for v, (scale, digits) in cells
            ]
            rows.append([f"{frequency} Hz, {PLANTS[plant]}", *shown])
    page.add(Figure([*plots], "Displacement and pressure at 0.25, 0.5, 1 and 2 Hz.", is_grid=True))
    page.add(
        ReportTable(
            ["last cycle", "mm, low", "high", "kPa, low", "high", "up, ms", "down, ms"],
            rows,
            "Displacement, absolute pressure, and the displacement's 10 to 90 % times.",
        )
    )
    return numbers


_FORMATS = ((1e3, 2), (1e3, 2), (1e-3, 1), (1e-3, 1), (1e3, 0), (1e3, 0))
"""Factor and digits of each figure of a cycle."""


def _make_plots(frequency: str, runs: dict[str, SimulatedRun]) -> list[Plot]:
    shown_s = 2.0 / float(frequency)
    time = PlotAxis("time", "s", tight=True)
    plots = []
    for what, column, scale, unit in (
        ("displacement", "true_position_m", 1e3, "mm"),
        ("pressure", "true_pressure_pa", 1e-3, "kPa"),
    ):
        plot = Plot(f"{frequency} Hz, {what}", time, PlotAxis("", unit), height_px=130)
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


FIGURES = {
    "fig4": ("tracking-1", "Fig. 4: experiment 1"),
    "fig5": ("tracking-2", "Fig. 5: experiment 2"),
}


def write_tracking(page: Report, figure: str, seed: int) -> dict[str, Any]:
    """Write Fig. 4 or 5; return the runs' figures of merit by case."""
    experiment, heading = FIGURES[figure]
    page.add(Section(heading))
    page.add(Text("On the model of Tables I and II, without the approach from the vented muscle."))
    qsmc, smc, *_ = TUNED
    page.add(Section("With the gains that the paper prints", is_part=True))
    page.add(
        Figure(
            [*_plot_stack((PRINTED_QSMC, FITTED_SMC), experiment, seed)],
            "qSMC as printed, and SMC as printed except K_p, which was fitted to Table IV.",
        )
    )
    page.add(Section("With tuned gains", is_part=True))
    page.add(
        Figure(
            [*_plot_stack((qsmc, smc), experiment, seed)], "qSMC and SMC, tuned with equal effort."
        )
    )
    cases = (PRINTED_QSMC, PRINTED_SMC, FITTED_SMC, qsmc, smc)
    return {case.name: case.summarise(experiment, "paper", seed) for case in cases}


def _plot_stack(cases: Sequence[Case], experiment: str, seed: int) -> list[Plot]:
    time = PlotAxis("time since the end of the approach", "s", tight=True)
    position = Plot("Displacement", time, PlotAxis("displacement", "mm"), height_px=160)
    error = Plot("Error", time, PlotAxis("x \N{MINUS SIGN} x_D", "µm"), height_px=130)
    command = Plot("Command", time, PlotAxis("u", "V"), height_px=110)
    pressure = Plot("Pressure", time, PlotAxis("absolute", "kPa"), height_px=110)
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


EXPERIMENTS = ("tracking-1", "tracking-2")

Errors = Mapping[str, Mapping[str, Mapping[str, float | None]]]
"""By experiment, and by case or by the paper's law."""
PAPER: Errors = {
    experiment: {row.law: row.merit.as_dict() for row in find_paper_rows(experiment)}
    for experiment in EXPERIMENTS
}


def write_table4(page: Report, seed: int) -> dict[str, Any]:
    """Write Table IV; return its numbers by plant, experiment and case, and the paper's."""
    page.add(Section("Table IV: controller performance"))
    measured = {
        plant: {
            experiment: {case.name: case.summarise(experiment, plant, seed) for case in ALL}
            for experiment in EXPERIMENTS
        }
        for plant in PLANTS
    }
    papers = [
        _make_row(f"paper's {find_law(law).title} on its rig", PAPER, law)
        for law in ("qsmc", "smc")
    ]
    for plant, title in PLANTS.items():
        rows = [*papers, *(_make_row(case.name, measured[plant], case.name) for case in ALL)]
        page.add(
            ReportTable(
                ["µm", "1: max", "RMS", "steady", "2: max", "RMS"],
                rows,
                f"Errors in experiments 1 and 2; the model {title}.",
            )
        )
    page.add(Points([*(f"{case.name}: {case.remark}." for case in ALL if case.remark)]))
    _write_findings(page, measured)
    return {"simulated": measured, "paper": PAPER}


def _make_row(name: str, errors: Errors, of: str) -> list[str]:
    one, two = (errors[experiment][of] for experiment in EXPERIMENTS)
    if one["max_m"] is None or two["max_m"] is None:
        return [name, *["trips"] * 5]
    values = (one["max_m"], one["rms_m"], one["steady_m"], two["max_m"], two["rms_m"])
    return [name, *map(spell_um, values)]


def is_within_bound(found: Mapping[str, float | None], bound: Mapping[str, float | None]) -> bool:
    """Tell whether no error is larger than the paper's, for every error that the paper states."""
    return all(
        limit is None or ((value := found[name]) is not None and value <= limit)
        for name, limit in bound.items()
    )


def _write_findings(page: Report, measured: Mapping[str, Errors]) -> None:
    page.add(Section("Which results reproduce, and which do not", is_part=True))
    for plant, title in PLANTS.items():
        kept = all(
            is_within_bound(measured[plant][name][PRINTED_QSMC.name], PAPER[name]["qsmc"])
            for name in EXPERIMENTS
        )
        verdict = "stays inside" if kept else "does not stay inside"
        page.add(
            Text(
                f"qSMC with the printed gains {verdict} Table IV in both experiments on the model "
                f"{title}.",
                "good" if kept else "bad",
            )
        )
    page.add(
        Text(
            "SMC with the printed gains does not track on either plant, and no reading of the "
            "printed K_p was found that reproduces the table: "
            "`pamctl manual table-iii-smc-does-not-reproduce`.",
            "bad",
        ),
        Text(
            "How the paper was read: `pamctl manual the-model`, and `gains-in-inches`. The tuned "
            "gains say nothing about the paper's rig: they show what these laws can do on this "
            "model, with its quantisation and its sensor noise."
        ),
    )


Part = Callable[[Report, int], dict[str, Any]]

PARTS: dict[str, Part] = {
    "fig3": write_fig3,
    "fig4": lambda page, seed: write_tracking(page, "fig4", seed),
    "fig5": lambda page, seed: write_tracking(page, "fig5", seed),
    "table4": write_table4,
}
"""The parts that can be reproduced, in the order of the paper."""

SCHEMA = 1


def reproduce_paper(
    parts: Sequence[str],
    seed: int,
    progress: Callable[[float, float, str], object] = lambda done, of, name: None,
) -> Report:
    """Simulate and lay out these of `PARTS`; the document is in SI, and equal for equal seeds.

    `progress` gets how many of how many are done, and the name of each as it begins.
    """
    page = Report(
        "The paper, reproduced",
        subtitle="Modeling of Pneumatic Artificial Muscle with Kinetic Friction and Sliding Mode "
        "Control",
        numbers_figures=False,
    )
    page.add(
        Text(
            f"Made by pamctl {__version__}, seed {seed}: the tick of the loop on the simulated "
            "rig, with an encoder of 3.175 µm per count and 300 Pa of pressure noise. Errors are "
            "measured displacement minus reference."
        )
    )
    numbers: dict[str, Any] = {"schema": SCHEMA, "version": __version__, "seed": seed}
    for done, name in enumerate(parts):
        progress(done, len(parts), name)
        numbers[name] = PARTS[name](page, seed)
    page.document = numbers
    return page
