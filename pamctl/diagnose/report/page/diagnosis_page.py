"""`report.html`: the diagnosis for a reader who was not there, on one page without a network.

The first screen has the verdict in plain words, the gap before and after as a picture, and
what to do next. The sections below give the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.extended_plant_file import format_plant_file
from pamctl.diagnose.report.page.findings_part import write_findings, write_trials
from pamctl.diagnose.report.page.head_part import write_head
from pamctl.diagnose.report.page.regime_map import write_map
from pamctl.diagnose.report.page.remains_part import (
    write_blind_spots,
    write_compared_runs,
    write_measured_runs,
    write_remainder,
)
from pamctl.diagnose.report.page.terms_part import write_terms
from pamctl.diagnose.report.page.traces_part import write_traces
from pamctl.diagnose.report.setup_part import write_setup
from pamctl.diagnose.report.verdict_words import choose_words
from pamctl.report.html_page import Page


def build_diagnosis_page(
    diagnosis: Diagnosis,
    records: Sequence[Record],
    story: Callable[[Page], None] | None = None,
) -> Page:
    """Return the page of a diagnosis; `records` are all records that were given, good or bad.

    `story` writes below the head how the records came about.
    """
    names = [record.name for record in records]
    page = Page(choose_words(diagnosis).title, f"Diagnosis of {', '.join(names)}")
    write_head(page, diagnosis)
    if story is not None:
        story(page)
    write_setup(page, diagnosis)
    if diagnosis.reason:
        write_compared_runs(page, diagnosis, records)
        write_measured_runs(page, records)
        return page
    write_traces(page, diagnosis)
    write_map(page, diagnosis)
    write_findings(page, diagnosis)
    write_terms(page, diagnosis)
    write_trials(page, diagnosis)
    write_remainder(page, diagnosis)
    write_blind_spots(page, diagnosis)
    write_compared_runs(page, diagnosis, records)
    page.fold("plant.yaml", format_plant_file(diagnosis, names))
    return page
