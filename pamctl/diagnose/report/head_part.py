"""The first screen: the verdict in plain words, the gap as a picture, what to do next."""

from __future__ import annotations

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report import page_words as words
from pamctl.diagnose.report.compared_models import SIGNAL_DISPLAYS, ModelStage, list_model_stages
from pamctl.diagnose.show import HeldOutGap
from pamctl.report.drawing.levels import Levels
from pamctl.report.html_page import Page

_KINDS = {
    Verdict.NO_DISCREPANCY: "good",
    Verdict.MISCALIBRATED: "good",
    Verdict.NAMED: "good",
    Verdict.BAD_DATA: "bad",
    Verdict.NONE_KNOWN: "bad",
}


def write_head(page: Page, diagnosis: Diagnosis) -> None:
    """Write what a reader without patience needs."""
    page.note(words.explain_verdict(diagnosis), kind=_KINDS.get(diagnosis.verdict, "note"))
    shown = list_model_stages(diagnosis)
    if diagnosis.gap:
        page.grid(
            *(_draw_levels(name, gap, shown) for name, gap in diagnosis.gap.items()),
            caption=_write_caption(diagnosis),
        )
    page.heading("What to do next")
    page.points(*words.advise_next_steps(diagnosis))


def _draw_levels(name: str, gap: HeldOutGap, shown: list[ModelStage]) -> Levels:
    signal = SIGNAL_DISPLAYS[name]
    levels = Levels(signal.title, signal.gap_unit)
    for stage in shown:
        value = float(getattr(gap, stage.key)) * signal.gap_factor
        levels.bar(stage.label, value, colour=stage.colour)
    levels.mark(gap.floor * signal.gap_factor)
    return levels


def _write_caption(diagnosis: Diagnosis) -> str:
    parts = [
        f"{100.0 * gap.closed:.1f} % of the "
        f"{SIGNAL_DISPLAYS[name].title.split(',')[0].lower()}'s gap"
        for name, gap in (diagnosis.gap or {}).items()
    ]
    closed = f" {' and '.join(parts)} is closed, from recalibrated to that line."
    named = diagnosis.model is not None and bool(diagnosis.model.effects)
    coupled = diagnosis.model is not None and len(diagnosis.model.evidence.blocks) == 2
    driven = "the whole model, driven by the command alone" if coupled else "the measured block"
    return (
        "What lies between measurement and simulation on records that nothing was fitted to, RMS: "
        f"{driven}. The dashed line is what the sensor itself adds." + (closed if named else "")
    )
