"""`pamctl report`: the page of one run, or of several side by side."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.log import Log
from pamctl.log.measured_signals import judge_ticks
from pamctl.report.filter_section import write_filtering
from pamctl.report.frequency_section import write_frequency_response
from pamctl.report.html_page import Page
from pamctl.report.law_section import write_law
from pamctl.report.motion_section import write_motion
from pamctl.report.record_section import (
    write_differences,
    write_events,
    write_safety,
    write_settings,
)
from pamctl.report.reported_run import ReportedRun, name_runs
from pamctl.report.summary_section import write_summary
from pamctl.report.timing_section import write_timing


def find_doubts(log: Log) -> list[str]:
    """Return what is doubtful in the ticks of a log; raise LogError if a page would be wrong."""
    if len(log) > 1:
        return judge_ticks(log, may_lack=True)
    return [f"holds {'one tick' if len(log) else 'no ticks'}: the run ended at once"]


def compose_report(logs: Sequence[Log], doubts: Sequence[Sequence[str]] | None = None) -> Page:
    """Return the page of at least one log; missing data are left out or mentioned.

    `doubts` has what `find_doubts` says of each log, if it is known.
    """
    doubts = [find_doubts(log) for log in logs] if doubts is None else doubts
    runs = name_runs(logs)
    page = Page(_make_title(runs), ", ".join(str(run.log.path.name) for run in runs))
    write_summary(page, runs)
    for run, found in zip(runs, doubts, strict=True):
        for doubt in found if len(run) > 1 else ():
            page.note(f"Doubtful in {run.name}: {doubt}.", kind="bad")
    if len(runs) > 1:
        write_differences(page, runs)
    measured = [run for run in runs if len(run)]
    for run in runs:
        if not len(run):
            page.note(
                f"{run.name} holds no ticks: the run ended before its first tick.", kind="bad"
            )
    if measured:
        for write in (
            write_motion,
            write_frequency_response,
            write_law,
            write_filtering,
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
