"""`pamctl report`: the page of one run, or of several side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import yaml

from pamctl.base.errors import ExitCode
from pamctl.base.texts import clean_text, count_of, flatten_keys, to_json
from pamctl.control.law_registry import find_law
from pamctl.log import Log
from pamctl.log.measured_signals import judge_ticks
from pamctl.log.run_meta import ANNOTATION, Annotation, describe_running_changes, spell_controller
from pamctl.offline.merit import find_paper_rows, summarise_timing
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import Plot
from pamctl.report.frequency import write_frequency_response
from pamctl.report.report import Facts, Figure, Fold, Report, ReportTable, Section, Text
from pamctl.report.reported_run import (
    MERIT_HEADER,
    MICRO,
    OTHER_ZERO,
    ReportedRun,
    has_other_zero,
    make_merit_row,
    name_runs,
    summarise_tracking,
    tabulate_timing,
)
from pamctl.report.run_motion import write_law, write_motion
from pamctl.safety import VERDICTS


def write_summary(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write the ending, the facts and the figures of merit of every run."""
    page.add(Section("Summary"))
    for run in _name_each(page, runs):
        _write_ending(page, run)
        page.add(Facts(_collect_facts(run)))
    _write_merits(page, runs)


def _name_each(page: Report, runs: Sequence[ReportedRun]) -> Iterator[ReportedRun]:
    """Yield the runs, each below its name where there are several."""
    for run in runs:
        if len(runs) > 1:
            page.add(Section(run.name, is_part=True))
        yield run


def _write_ending(page: Report, run: ReportedRun) -> None:
    if run.log.is_imported:
        source = run.log.metadata.get("import", {}).get("source", "another system")
        page.add(Text(f"Imported measurement of another system: {source}", "note"))
        return
    ended = run.log.outcome
    if ended is None:
        page.add(Text("The log does not say how the run ended: it was not finished.", "bad"))
        return
    code = int(ended.get("code", -1))
    kind = "good" if code == ExitCode.OK else "bad"
    reason = str(ended.get("reason", ""))
    page.add(Text(f"Ended with exit code {code}: {reason[:1].upper()}{reason[1:]}.", kind))


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


def _write_merits(page: Report, runs: Sequence[ReportedRun]) -> None:
    tracked = {run.name: summarise_tracking(run.log) for run in runs}
    rows = [
        make_merit_row(f"{name}, {what}", merit.values())
        for name, tracking in tracked.items()
        for what, merit in tracking.items()
        if merit["max_m"] is not None
    ]
    if not rows:
        if any(len(run) and not run.log.is_imported for run in runs):
            page.add(Text("Nothing was tracked: there is no error to state."))
        return
    experiments = {run.paper_experiment for run in runs if run.tracked.any()}
    for experiment in sorted(name for name in experiments if name):
        rows += [
            make_merit_row(f"paper's {find_law(row.law).title} on its rig, {experiment}", row.merit)
            for row in find_paper_rows(experiment)
        ]
    page.add(
        ReportTable(
            MERIT_HEADER,
            rows,
            "Without the approach; steady is the largest error in the last 5 s of rests.",
        )
    )
    if None in experiments and len(experiments) > 1:
        page.add(
            Text("Where settings differ from the paper's experiments, Table IV does not apply.")
        )
    if any(map(has_other_zero, tracked.values())):
        page.add(Text(OTHER_ZERO))


MOST_EVENTS = 200
_WHERE = ("event", "tick", "t_ns", "row")


def write_safety(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write every clip and trip with its reason and time."""
    page.add(Section("Safety"))
    for run in _name_each(page, runs):
        verdicts = run.log.columns.get("verdicts")
        if verdicts is None:
            page.add(Text("The log was made without these safety rules: clips are unknown."))
            continue
        rows = [
            [
                "clip" if bit < 1 << 8 else "trip",
                meaning,
                str(len(at)),
                *(f"{run.t_s[tick]:.3f}" for tick in at[[0, -1]]),
            ]
            for bit, meaning in VERDICTS.items()
            if len(at := np.flatnonzero(np.asarray(verdicts, np.int64) & bit))
        ]
        if rows:
            page.add(ReportTable(["", "reason", "ticks", "first, s", "last, s"], rows))
        else:
            page.add(Text("Safety clipped no command and did not trip."))


def write_events(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write the events in order."""
    page.add(Section("Events"))
    for run in _name_each(page, runs):
        events = run.log.events
        if not events:
            page.add(Text("The log has no events."))
            continue
        rows = [[_show_time(run, e), str(e.get("event", "")), _show_details(e)] for e in events]
        page.add(ReportTable(["at, s", "event", "details"], rows[:MOST_EVENTS]))
        if len(rows) > MOST_EVENTS:
            page.add(Text(f"The log has {count_of(len(rows) - MOST_EVENTS, 'more event')}."))


def _show_time(run: ReportedRun, event: Mapping[str, Any]) -> str:
    at_s = run.time_of(event)
    return "-" if at_s is None else f"{at_s:.3f}"


def _show_details(event: Mapping[str, Any]) -> str:
    parts = ((name, value) for name, value in event.items() if name not in _WHERE)
    return ", ".join(f"{name} {_show_short(value)}" for name, value in parts)


def _show_short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return clean_text(value) if isinstance(value, str) else to_json(value).decode()


def write_differences(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write a table of the settings that differ between the runs."""
    page.add(Section("What differs"))
    settings = [dict(flatten_keys(run.log.config)) for run in runs]
    keys = dict.fromkeys(key for setting in settings for key in setting)
    rows = [
        [key, *(_show_short(setting.get(key, "-")) for setting in settings)]
        for key in keys
        if len({_show_short(setting.get(key, "-")) for setting in settings}) > 1
    ]
    if rows:
        page.add(ReportTable(["setting", *(run.name for run in runs)], rows))
    else:
        page.add(Text("The runs have the same settings."))


def write_settings(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write versions, rig and resolved configuration, folded."""
    page.add(Section("Configuration"))
    for run in runs:
        whose = f" of {run.name}" if len(runs) > 1 else ""
        for name, title in (
            ("pamctl", "Versions"),
            ("timing_setup", "Real-time measures"),
            ("rig", "The rig's own description"),
            ("import", "Import"),
        ):
            if name in run.log.metadata:
                page.add(Fold(f"{title}{whose}", _format_yaml(dict(run.log.metadata[name]))))
        if run.log.config:
            page.add(Fold(f"Resolved configuration{whose}", _format_yaml(run.log.config)))
        else:
            page.add(Text(f"The log{whose} carries no configuration."))


def _format_yaml(value: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(value), sort_keys=False, allow_unicode=True).rstrip()


MOST_PLACES = 10
FASTEST_US, SLOWEST_US = 0.1, 1e6


def write_timing(page: Report, runs: Sequence[ReportedRun]) -> None:
    """Write the durations of a tick's parts, and which ticks were late or missed."""
    page.add(Section("Timing"))
    for run in _name_each(page, runs):
        if run.fast:
            page.add(Text("Simulated without a clock: there is no timing to show."))
            continue
        if len(run) < 2:
            page.add(Text("Too few ticks for timing figures."))
            continue
        if run.column("late_s") is not None:
            page.add(tabulate_timing(summarise_timing(run.log)))
        _plot_histograms(page, run)
        _write_missed(page, run)


def _plot_histograms(page: Report, run: ReportedRun) -> None:
    durations = {"Wake-up behind deadline": run.column("late_s")}
    durations["Read, tick and write"] = _compute_work_s(run)
    plots: list[Plot] = []
    for title, values in durations.items():
        if values is None:
            continue
        edges = np.geomspace(FASTEST_US, SLOWEST_US, 141)
        counts, _ = np.histogram(np.clip(values * MICRO, FASTEST_US, SLOWEST_US), edges)
        used = np.flatnonzero(counts)
        first, last = max(0, used[0] - 2), min(len(counts), used[-1] + 3)
        x = PlotAxis("duration (0.1 means 0.1 or less)", "µs", log=True, tight=True)
        plot = Plot(title, x, PlotAxis("ticks", low=0.5, log=True), height_px=150)
        sides = np.repeat(edges[first : last + 1], 2)[1:-1]
        heights = np.repeat(np.maximum(counts[first:last], 0.5), 2)
        plots.append(plot.band(sides, 0.5, heights, solid=True))
    if plots:
        said = "Both axes are logarithmic: a single tick is still a bar."
        page.add(Figure([*plots], said, is_grid=True))
        return
    steps_ms = np.diff(run.log["t_s"]) * 1e3
    spread = f"{steps_ms.min():.4g} to {steps_ms.max():.4g} ms, usually {np.median(steps_ms):.4g}"
    page.add(Text(f"This log has no timing data but the time between samples: {spread}."))


def _compute_work_s(run: ReportedRun) -> np.ndarray | None:
    parts = [run.column(name) for name in ("read_s", "compute_s", "write_s")]
    known = [part for part in parts if part is not None]
    return np.sum(known, axis=0) if len(known) == len(parts) else None


def _write_missed(page: Report, run: ReportedRun) -> None:
    missed = run.log["missed"]
    at = np.flatnonzero(missed > 0)
    if not len(at):
        page.add(Text("No tick was missed."))
        return
    largest = at[np.argsort(-missed[at], kind="stable")][:MOST_PLACES]
    longest = ", ".join(f"{missed[i]} before {run.t_s[i]:.3f} s" for i in sorted(largest))
    missed_in = f"{count_of(int(missed.sum()), 'tick')} in {count_of(len(at), 'place')}"
    page.add(Text(f"Missed: {missed_in}; the most: {longest}."))


def find_doubts(log: Log) -> list[str]:
    """Return what is doubtful in the ticks of a log; raise LogError if a page would be wrong."""
    if len(log) > 1:
        return judge_ticks(log, may_lack=True)
    return [f"holds {'one tick' if len(log) else 'no ticks'}: the run ended at once"]


def compose_report(logs: Sequence[Log], doubts: Sequence[Sequence[str]] | None = None) -> Report:
    """Return the page of at least one log; missing data are left out or mentioned.

    `doubts` has what `find_doubts` says of each log, if it is known.
    """
    doubts = [find_doubts(log) for log in logs] if doubts is None else doubts
    runs = name_runs(logs)
    page = Report(_make_title(runs), subtitle=", ".join(str(run.log.path.name) for run in runs))
    write_summary(page, runs)
    for run, found in zip(runs, doubts, strict=True):
        for doubt in found if len(run) > 1 else ():
            page.add(Text(f"Doubtful in {run.name}: {doubt}.", "bad"))
    if len(runs) > 1:
        write_differences(page, runs)
    measured = [run for run in runs if len(run)]
    for run in runs:
        if not len(run):
            page.add(
                Text(f"{run.name} holds no ticks: the run ended before its first tick.", "bad")
            )
    if measured:
        for write in (
            write_motion,
            write_frequency_response,
            write_law,
            write_timing,
            write_safety,
        ):
            write(page, measured)
    write_events(page, runs)
    write_settings(page, runs)
    return page


def _make_title(runs: Sequence[ReportedRun]) -> str:
    if len(runs) > 1:
        return f"{len(runs)} runs side by side"
    meta = runs[0].meta
    if runs[0].log.is_imported:
        return f"Imported measurement {runs[0].name}"
    return f"{meta.get('controller', 'a run')} in {meta.get('experiment', 'an experiment')}"
