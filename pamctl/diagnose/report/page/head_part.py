"""The first screen: the verdict in plain words, the gap as a picture, what to do next."""

from __future__ import annotations

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.report.compared_models import SIGNAL_DISPLAYS, ModelStage, list_model_stages
from pamctl.diagnose.report.verdict_words import advise_next_steps, choose_words
from pamctl.diagnose.show import HeldOutGap
from pamctl.report.drawing.levels import Levels
from pamctl.report.html_page import Page


def write_head(page: Page, diagnosis: Diagnosis) -> None:
    """Write the verdict, the gap and the next steps."""
    words = choose_words(diagnosis)
    page.note(words.explanation, kind=words.kind)
    stages = list_model_stages(diagnosis)
    if diagnosis.gap:
        page.grid(
            *(_draw_levels(name, gap, stages) for name, gap in diagnosis.gap.items()),
            caption=_write_caption(diagnosis),
        )
    page.heading("What to do next")
    page.points(*advise_next_steps(diagnosis))


def _draw_levels(name: str, gap: HeldOutGap, stages: list[ModelStage]) -> Levels:
    signal = SIGNAL_DISPLAYS[name]
    values = [float(getattr(gap, stage.key)) for stage in stages]
    factor, unit = signal.choose_unit(max(values))
    levels = Levels(signal.title, unit)
    for stage, value in zip(stages, values, strict=True):
        levels.bar(stage.label, factor * value, colour=stage.colour)
    levels.mark(factor * gap.floor)
    return levels


def _write_caption(diagnosis: Diagnosis) -> str:
    parts = [
        f"{100.0 * gap.closed:.1f} % of the "
        f"{SIGNAL_DISPLAYS[name].title.split(',')[0].lower()}'s gap"
        for name, gap in (diagnosis.gap or {}).items()
    ]
    closed = f" The effects close {' and '.join(parts)}, counted from recalibrated to this line."
    named = diagnosis.model is not None and bool(diagnosis.model.effects)
    coupled = diagnosis.model is not None and len(diagnosis.model.evidence.blocks) == 2
    driven = "The whole model is driven by the command alone." if coupled else ""
    return (
        "RMS of measurement minus simulation, on samples that were used for no fit and no choice. "
        f"{driven} The dashed line is the sensor's own noise." + (closed if named else "")
    )
