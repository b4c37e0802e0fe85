"""The diagnosis for a terminal: the sentence, then the numbers behind it."""

from __future__ import annotations

from collections.abc import Iterator

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.report.next_experiment import choose_next_experiment
from pamctl.diagnose.report.phrases import (
    describe_limits,
    describe_noise,
    describe_remainder,
    describe_substeps,
    gap_units,
    mark_bound,
)
from pamctl.diagnose.report.setup_part import list_setup_rows
from pamctl.diagnose.report.term_phrases import describe_questions
from pamctl.diagnose.report.verdict_words import sentence


def summary(diagnosis: Diagnosis) -> str:
    """Lay the diagnosis out for a terminal: the sentence, then what it rests on."""
    return "\n\n".join(part for part in _list_parts(diagnosis) if part)


def _list_parts(diagnosis: Diagnosis) -> Iterator[str]:
    yield f"{diagnosis.verdict.value}: {sentence(diagnosis)}"
    yield "\n".join(list_setup_rows(diagnosis))
    if diagnosis.numbers:
        yield "\n".join(_number_rows(diagnosis))
    if diagnosis.standings:
        yield "\n".join(_rival_rows(diagnosis))
    if diagnosis.gap:
        yield "\n".join(_gap_rows(diagnosis))
    floors = diagnosis.model.floors.values() if diagnosis.model else ()
    if diagnosis.model and any(floor.decided_by != "self-simulation" for floor in floors):
        yield describe_limits(diagnosis.model)
    yield describe_noise(diagnosis)
    yield describe_substeps(diagnosis.substep_changes)
    if diagnosis.remainder is not None:
        yield describe_remainder(diagnosis.remainder, diagnosis.nominal.actuator)
    yield describe_questions(diagnosis)
    for accepted in diagnosis.accepted:
        yield f"accepted ({accepted.rule}): {accepted.reason}: {'; '.join(accepted.doubts)}"
    experiment = choose_next_experiment(diagnosis)
    if experiment:
        yield f"next: {experiment['do']}  # {experiment['why']}"


def _number_rows(diagnosis: Diagnosis) -> Iterator[str]:
    yield f"{'fitted':<36}{'value':>12}  90 % interval"
    for n in diagnosis.numbers:
        bound = mark_bound(diagnosis, n.name)
        line = f"{n.name:<36}{n.value:>12.5g}  {n.low:.5g} to {n.high:.5g} {n.unit}".rstrip()
        yield f"{line}  ({bound} of the range)" if bound else line


def _rival_rows(diagnosis: Diagnosis) -> Iterator[str]:
    yield f"{'effect':<24}{'rival':<24}{'left, x floor':>14}"
    for standing in diagnosis.standings:
        for rival in standing.rivals[:3]:
            equal = "  these data do not tell it apart" if rival.is_equal else ""
            left = f"{rival.residual_over_floor:>14.2f}{equal}"
            yield f"{standing.effect.name:<24}{rival.name:<24}{left}"


def _gap_rows(diagnosis: Diagnosis) -> Iterator[str]:
    columns = f"{'start model':>12}{'recalibrated':>14}{'extended':>12}{'floor':>10}"
    yield f"{'held-out gap, RMS':<20}{columns}"
    for channel, gap in (diagnosis.gap or {}).items():
        factor, label = gap_units(channel)
        levels = [gap.nominal, gap.recalibrated, gap.extended, gap.floor]
        a, b, c, d = (f"{factor * level:.4g}" for level in levels)
        yield f"{label:<20}{a:>12}{b:>14}{c:>12}{d:>10}"
