"""`pamctl report`: the page of one run, or of several side by side."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.log import Log
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


def compose_report(logs: Sequence[Log]) -> Page:
    """Return the page of at least one log; missing data are left out or mentioned."""
    runs = name_runs(logs)
    page = Page(_make_title(runs), ", ".join(str(run.log.path.name) for run in runs))
    write_summary(page, runs)
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
