"""Table IV: the paper's rig and this software's simulation side by side."""

from __future__ import annotations

import math
from typing import Any

from pamctl.control.law_registry import find_law
from pamctl.control.smc import SmcSettings, linearise_model
from pamctl.plant.model import plant_parameters
from pamctl.report.html_page import Page
from pamctl.reproduce.paper_cases import (
    ALL,
    FITTED_SMC,
    PLANTS,
    PRINTED_QSMC,
    PRINTED_SMC,
    UNHINDERED_SMC,
    Case,
)
from pamctl.reproduce.tracking import summarise_outcome
from pamctl.simulate.merit import TABLE_IV

EXPERIMENTS = ("tracking-1", "tracking-2")

Numbers = dict[str, dict[str, dict[str, dict[str, float | None]]]]


def write_table4(page: Page, seed: int) -> dict[str, Any]:
    """Write Table IV; return its numbers by plant, experiment and case, and the paper's."""
    page.section("Table IV: controller performance")
    measured = {
        plant: {
            experiment: {
                case.name: summarise_outcome(case.run(experiment, plant, seed)) for case in ALL
            }
            for experiment in EXPERIMENTS
        }
        for plant in PLANTS
    }
    for plant, title in PLANTS.items():
        page.table(
            ["µm", "1: max", "RMS", "steady", "2: max", "RMS"],
            [*_make_paper_rows(), *(_make_row(case, measured[plant]) for case in ALL)],
            caption=f"Errors in experiments 1 and 2; the model {title}.",
        )
    page.points(*(f"{case.name}: {case.remark}." for case in ALL if case.remark))
    _write_findings(page, measured, seed)
    return {"simulated": measured, "paper": _collect_paper_numbers()}


def _make_paper_rows() -> list[list[str]]:
    rows = []
    for law in sorted({row.law for row in TABLE_IV}):
        cells = [
            _format_cell(value)
            for row in TABLE_IV
            if row.law == law
            for value in row.merit
            if not math.isnan(value)
        ]
        rows.append([f"paper's {find_law(law).title} on its rig", *cells])
    return rows


def _make_row(case: Case, of_plant: dict[str, dict[str, dict[str, float | None]]]) -> list[str]:
    one, two = (of_plant[experiment][case.name] for experiment in EXPERIMENTS)
    if one["max_m"] is None or two["max_m"] is None:
        return [case.name, *["trips"] * 5]
    values = (one["max_m"], one["rms_m"], one["steady_m"], two["max_m"], two["rms_m"])
    return [case.name, *(_format_cell(value) for value in values)]


def _format_cell(value: float | None) -> str:
    return "-" if value is None else f"{value * 1e6:.1f}"


def _collect_paper_numbers() -> dict[str, dict[str, dict[str, float | None]]]:
    return {
        experiment: {
            row.law: {k: None if math.isnan(v) else v for k, v in row.merit._asdict().items()}
            for row in TABLE_IV
            if row.experiment == experiment
        }
        for experiment in EXPERIMENTS
    }


def is_within_bound(found: dict[str, float | None], bound: dict[str, float | None]) -> bool:
    """Tell whether no error is larger than the paper's, for every error that the paper states."""
    return all(
        limit is None or ((value := found[name]) is not None and value <= limit)
        for name, limit in bound.items()
    )


def _write_findings(page: Page, measured: Numbers, seed: int) -> None:
    page.heading("Which results reproduce, and which do not")
    for plant, title in PLANTS.items():
        _write_about_qsmc(page, measured[plant], title)
    _write_about_smc(page, measured["paper"]["tracking-2"][UNHINDERED_SMC.name]["max_m"], seed)
    page.text(
        "The important readings, each tried. The headings of Table III are crossed: q = 1 is the "
        "traditional law, so its column belongs to Eq. 18. The gains are in inches, where "
        "25.4 mm/s³ is a round 1 inch/s³; the row in millimetres shows the other reading. "
        "lambda is the printed number in 1/s, without 2 pi. LPF_2 is 0.5 Hz literally, "
        "on the derivatives of the error. Friction at rest is a band.",
        f"{FITTED_SMC.name}: with this one number changed by a factor of 2600, the maximum and RMS "
        "errors of SMC come close to the table; the steady error does not. The reason for such "
        "a factor is not known.",
        "The tuned gains say nothing about the paper's rig: they show what these laws can do on "
        "this model, with its quantisation and its sensor noise.",
    )


def _write_about_qsmc(page: Page, measured: dict[str, Any], title: str) -> None:
    paper = _collect_paper_numbers()
    pairs = [
        (measured[experiment][PRINTED_QSMC.name], paper[experiment]["qsmc"])
        for experiment in EXPERIMENTS
    ]
    kept = all(is_within_bound(found, bound) for found, bound in pairs)
    ratios = [
        found[name] / limit
        for found, bound in pairs
        for name, limit in bound.items()
        if limit is not None and found[name] is not None
    ]
    verdict = "stays inside" if kept else "does not stay inside"
    spread = f": {min(ratios):.2f} to {max(ratios):.2f} of its errors" if ratios else ""
    page.note(
        f"qSMC with the printed gains {verdict} Table IV in both experiments on the model "
        f"{title}{spread}.",
        kind="good" if kept else "bad",
    )


def _write_about_smc(page: Page, unhindered_m: float | None, seed: int) -> None:
    gain, most_v = _compute_smc_reach(seed)
    unhindered = (
        ""
        if unhindered_m is None
        else " With the limit on the error lifted, the error of experiment 2 reaches "
        f"{unhindered_m * 1e3:.1f} mm."
    )
    page.note(
        f"SMC with the printed gains does not track on either plant. g-hat is {gain:.2g} m/s³/V "
        "at rest at mid-stroke, for a moving mass of 0.05 kg; K_p / g-hat then leaves a command "
        f"within {most_v * 1e3:.2g} mV until safety ends the run.{unhindered} No reading of the "
        "printed K_p was found that reproduces the table.",
        kind="bad",
    )


def _compute_smc_reach(seed: int) -> tuple[float, float]:
    """Return g-hat at mid-stroke at rest (m/s^3/V), and the printed SMC's largest command (V)."""
    run = PRINTED_SMC.run("tracking-2", "paper", seed)
    settings = run.settings.controller
    assert isinstance(settings, SmcSettings)
    experiment: Any = run.settings.experiment
    mid_m = experiment.offset_mm * 1e-3
    p = plant_parameters(settings.model).paper
    mid_pa = 0.5 * (p.tank_pressure_pa + p.atmospheric_pressure_pa)
    gain = linearise_model(p, mid_m, 0.0, 0.0, mid_pa).fill_gain
    return gain, float(abs(run["command_v"]).max())
