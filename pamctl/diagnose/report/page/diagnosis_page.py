"""`report.html`: the diagnosis for a reader who was not there, on one page without a network.

The first screen has the verdict in plain words, the gap before and after as a picture, and
what to do next. The sections below give the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pamctl.diagnose.diagnosis import Diagnosis, HeldOutGap
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.extended_plant_file import format_plant_file
from pamctl.diagnose.report.page.findings_part import write_findings, write_setup
from pamctl.diagnose.report.page.remains_part import (
    write_blind_spots,
    write_compared_runs,
    write_measured_runs,
)
from pamctl.diagnose.report.page.traces_part import ModelStage, list_stages, write_traces
from pamctl.diagnose.report.phrases import SIGNAL_DISPLAYS
from pamctl.diagnose.report.verdict_words import advise_next_steps, choose_words
from pamctl.report.drawing.levels import Levels
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
    _write_head(page, diagnosis)
    if story is not None:
        story(page)
    if diagnosis.reason:
        write_compared_runs(page, diagnosis, records)
        write_measured_runs(page, records)
        return page
    write_setup(page, diagnosis)
    write_traces(page, diagnosis)
    write_findings(page, diagnosis)
    write_blind_spots(page, diagnosis)
    write_compared_runs(page, diagnosis, records)
    page.fold("plant.yaml", format_plant_file(diagnosis, names))
    return page


def _write_head(page: Page, diagnosis: Diagnosis) -> None:
    """Write the verdict, the gap and the next steps."""
    words = choose_words(diagnosis)
    page.note(words.explanation, kind=words.kind)
    stages = list_stages(diagnosis)
    if stages:
        page.grid(
            *(_draw_levels(name, gap, stages) for name, gap in diagnosis.gap.items()),
            caption=_write_caption(diagnosis),
        )
    page.heading("What to do next")
    page.points(*advise_next_steps(diagnosis))


def _draw_levels(name: str, gap: HeldOutGap, stages: Sequence[ModelStage]) -> Levels:
    signal = SIGNAL_DISPLAYS[name]
    values = [float(getattr(gap, stage.key)) for stage in stages]
    factor, unit = signal.choose_unit(max(values))
    levels = Levels(signal.title, unit)
    for stage, value in zip(stages, values, strict=True):
        levels.bar(stage.label, factor * value, colour=stage.colour)
    levels.mark(factor * gap.floor)
    return levels


def _write_caption(diagnosis: Diagnosis) -> str:
    used = (
        "on seconds that were used for no fit"
        if diagnosis.is_held_out
        else "on the fitted records, since none were held out"
    )
    parts = [
        f"{100.0 * gap.closed:.1f} % of the {SIGNAL_DISPLAYS[name].short}'s gap"
        for name, gap in diagnosis.gap.items()
        if gap.is_open
    ]
    closed = f" The findings close {' and '.join(parts)}, counted from recalibrated to this line."
    return (
        f"RMS of measurement minus simulation, {used}. The dashed line is the sensor's own noise."
        + (closed if parts and diagnosis.findings else "")
    )
