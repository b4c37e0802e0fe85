"""The figures of a run: tracking beside Table IV, and timing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from pamctl.log.reader import Log
from pamctl.plant.model import PlantSettings
from pamctl.report.report import Report, ReportTable, Text, format_terminal, spell_um
from pamctl.settings.resolve import resolve, settings_to_data
from pamctl.simulate.merit import TABLE_IV, Merit, compute_log_merits, summarise_timing

PAPER_EXPERIMENTS = ("tracking-1", "tracking-2")
FIGURE_FIELDS = (
    *("t_s", "phase", "missed", "reference_m"),
    *("position_m", "corrected_position_m", "true_position_m"),
    *("late_s", "read_s", "compute_s", "write_s"),
)
"""The columns of a log that `summarise_run` needs."""


def find_paper_experiment(config: Mapping[str, Any]) -> str | None:
    """Return the paper's experiment of which a run's settings are: Table IV is about those.

    None for another experiment, and for another muscle than the paper's; what its model lacks, the
    `effects`, do not count.
    """
    paper, plant = settings_to_data(PlantSettings()), config.get("plant", {})
    if any(plant.get(key, paper.get(key)) != paper.get(key) for key in ("actuator", "parameters")):
        return None
    return next(
        (
            name
            for name in PAPER_EXPERIMENTS
            if settings_to_data(resolve(experiment=name).experiment) == config.get("experiment")
        ),
        None,
    )


def summarise_run(log: Log) -> dict[str, Any]:
    """Return the figures of a run as one JSON document: SI, None for what is not known."""
    experiment = find_paper_experiment(log.config)
    setup, refused = log.metadata.get("timing_setup", {}), "not done: "
    return {
        "ticks": len(log),
        "missed_ticks": int(log["missed"].sum()),
        "readonly": bool(log.config.get("readonly")),
        "tracking": {name: _plain_merit(m) for name, m in compute_log_merits(log).items()},
        "paper": [
            {"law": row.law, **_plain_merit(row.merit)}
            for row in TABLE_IV
            if row.experiment == experiment
        ],
        "timing": None
        if log.config.get("fast")
        else {name: spread._asdict() for name, spread in summarise_timing(log).items()},
        "not_real_time": {
            step: said.removeprefix(refused)
            for step, said in setup.items()
            if said.startswith(refused)
        },
    }


def _plain_merit(merit: Merit | None) -> dict[str, Any]:
    if merit is None:
        return dict.fromkeys(Merit._fields)
    return {name: None if math.isnan(v) else v for name, v in merit._asdict().items()}


MERIT_HEADER = ("tracking error, µm", "max", "RMS", "steady")


def make_merit_row(name: str, errors_m: Iterable[float | None]) -> list[str]:
    """Return a row of a table with `MERIT_HEADER`, of the largest, RMS and steady error in m."""
    return [name, *map(spell_um, errors_m)]


def format_run_summary(figures: Mapping[str, Any], law: str) -> str:
    """Lay the figures out for a terminal."""
    return format_terminal(report_run(figures, law))


def report_run(figures: Mapping[str, Any], law: str) -> Report:
    """Return what is said of a run at its end, from the document of `summarise_run`."""
    ran = f"{figures['ticks']} ticks, {figures['missed_ticks']} missed"
    if figures["timing"] is None:
        ran += "; simulated without a clock"
    report = Report(f"Run of {law}", ran, document=figures).add(_report_tracking(figures, law))
    if figures["timing"] is not None:
        spreads = ((name, figures["timing"][key]) for key, name in _TIMING_NAMES.items())
        rows = [
            [name, *(spell_um(spread[part]) for part in ("p50_s", "p99_s", "max_s"))]
            for name, spread in spreads
        ]
        report.add(ReportTable(("timing, µs", "p50", "p99", "max"), rows))
    refused = figures["not_real_time"].items()
    return report.add(*(Text(f"not real time: {step} refused: {why}") for step, why in refused))


_TIMING_NAMES = {
    "wake_up": "wake-up behind deadline",
    "tick": "tick, sample to command",
    "period_work": "read, tick and write",
}


def _report_tracking(figures: Mapping[str, Any], law: str) -> ReportTable | Text:
    if figures["readonly"]:
        return Text("Read only: the output stayed at the safe voltage; nothing was tracked.")
    rows = [
        make_merit_row(f"{law}, {name} displacement", merit.values())
        for name, merit in figures["tracking"].items()
        if merit["max_m"] is not None
    ]
    if not rows:
        return Text("Nothing was tracked in this run.")
    rows += [
        make_merit_row(f"paper, {row['law']} on its rig", [row[name] for name in Merit._fields])
        for row in figures["paper"]
    ]
    return ReportTable(MERIT_HEADER, rows)
