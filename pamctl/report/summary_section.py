"""The result of a run: how it ended, what it was, how well it tracked."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pamctl.exit_codes import ExitCode
from pamctl.log.annotation import ANNOTATION, Annotation
from pamctl.log.moments import describe_running_changes, spell_controller
from pamctl.report.html_page import Page
from pamctl.report.reported_run import ReportedRun, law_name, paper_rows
from pamctl.simulate.merit import Merit, compute_merit

MICRO = 1e6
_HEADER = ("tracking error, µm", "max", "RMS", "steady")


def write_summary(page: Page, runs: Sequence[ReportedRun]) -> None:
    """Write the ending, the facts and the figures of merit of every run."""
    page.section("Summary")
    for run in runs:
        if len(runs) > 1:
            page.heading(run.name)
        _write_ending(page, run)
        page.facts(_collect_facts(run))
    _write_merits(page, runs)


def _write_ending(page: Page, run: ReportedRun) -> None:
    if run.log.is_imported:
        source = run.log.metadata.get("import", {}).get("source", "another system")
        page.note(f"Imported measurement of another system: {source}")
        return
    ended = run.outcome
    if ended is None:
        page.note("The log does not say how the run ended: it was not finished.", kind="bad")
        return
    code = int(ended.get("code", -1))
    kind = "good" if code == ExitCode.OK else "bad"
    reason = str(ended.get("reason", ""))
    page.note(f"Ended with exit code {code}: {reason[:1].upper()}{reason[1:]}.", kind=kind)


def _collect_facts(run: ReportedRun) -> dict[str, object]:
    known = run.meta
    origin = run.log.metadata.get("pamctl", {})
    facts: dict[str, object] = {
        key: known[key]
        for key in ("law", "controller", "experiment", "plant", "rig", "backend")
        if key in known
    }
    said = Annotation.from_metadata(run.log.metadata.get(ANNOTATION, {}))
    about = {"operator": said.operator, "sample": said.sample, "tags": " ".join(said.tags)}
    facts |= {name: text for name, text in {**about, "note": said.note}.items() if text}
    if "controller" in facts:
        facts["controller"] = spell_controller(known)
    if (running := describe_running_changes(run.log.gains)) is not None:
        facts["gains changed while it ran"] = running
    facts["ticks"] = f"{len(run):,}".replace(",", " ")
    if len(run):
        length_s = float(run.log["t_s"][-1] - run.log["t_s"][0])
        facts["length"] = f"{length_s:.3f} s"
        facts["missed ticks"] = int(run.log["missed"].sum()) if "missed" in run.log.columns else "-"
    if run.fast:
        facts["clock"] = "none, simulated (--fast)"
    elif "start" in origin and not run.log.is_imported:
        facts["started"] = origin["start"].split(".")[0].replace("T", " ") + " UTC"
    if run.log.config.get("duration_s") is not None:
        facts["cut short"] = f"to {run.log.config['duration_s']:g} s (--duration)"
    if run.log.config.get("readonly"):
        facts["output"] = "pinned to the safe voltage (--readonly)"
    return facts


def _write_merits(page: Page, runs: Sequence[ReportedRun]) -> None:
    rows = [row for run in runs for row in make_merit_rows(run)]
    if not rows:
        if any(len(run) for run in runs):
            page.text("Nothing was tracked: there is no error to compare with Table IV.")
        return
    experiments = {run.paper_experiment for run in runs if run.tracked.any()}
    for experiment in sorted(name for name in experiments if name):
        rows += [
            [f"paper's {law_name(row.law)} on its rig, {experiment}", *format_merit(row.merit)]
            for row in paper_rows(experiment)
        ]
    page.table(
        _HEADER,
        rows,
        caption="Without the approach; steady is the largest error in the last 5 s of rests.",
    )
    if None in experiments:
        page.text("Where settings differ from the paper's experiments, Table IV does not apply.")


def make_merit_rows(run: ReportedRun) -> list[list[str]]:
    """Return the table rows of a run: measured, and true if it was simulated."""
    reference, rows = run.column("reference_m"), []
    if reference is None:
        return []
    for what, position in (("measured", run.followed_m), ("true", run.column("true_position_m"))):
        found = (
            None if position is None else compute_merit(run.t_s, run.phase, position - reference)
        )
        if found is not None:
            rows.append([f"{run.name}, {what}", *format_merit(found)])
    return rows


def format_merit(found: Merit) -> list[str]:
    """Return max, RMS and steady-state error in micrometres."""
    return ["-" if math.isnan(value) else f"{value * MICRO:.1f}" for value in found]


def rms_of_finite(values: np.ndarray) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else math.nan
