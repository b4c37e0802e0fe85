"""The diagnosis for a terminal: the sentence, then the numbers behind it."""

from __future__ import annotations

from collections.abc import Iterator

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.report.diagnosis_document import find_masked_shares
from pamctl.diagnose.report.finding_words import (
    describe_standing,
    label_hypothesis,
    list_numbers,
    spell_finding,
    spell_names,
)
from pamctl.diagnose.report.next_experiment import choose_next_experiment
from pamctl.diagnose.report.open_findings import list_faults
from pamctl.diagnose.report.phrases import SIGNAL_DISPLAYS, describe_noise
from pamctl.diagnose.report.verdict_words import sentence

MOST_RIVALS = 3


def summary(diagnosis: Diagnosis) -> str:
    """Lay the diagnosis out for a terminal: the sentence, then what it rests on."""
    return "\n\n".join(part for part in _list_parts(diagnosis) if part)


def _list_parts(diagnosis: Diagnosis) -> Iterator[str]:
    yield f"{diagnosis.verdict.value}: {sentence(diagnosis)}"
    yield "\n".join(
        f"set-up: {fault.text}\n  to mend it: {fault.how_to_mend}"
        for fault in list_faults(diagnosis)
    )
    yield "\n".join(_list_finding_rows(diagnosis))
    yield "\n".join(_list_number_rows(diagnosis))
    yield "\n".join(_list_gap_rows(diagnosis))
    yield "\n".join(_list_masks(diagnosis))
    yield "\n".join(describe_noise(diagnosis))
    for accepted in diagnosis.accepted:
        yield f"accepted ({accepted.rule}): {accepted.reason}: {'; '.join(accepted.doubts)}"
    experiment = choose_next_experiment(diagnosis)
    if experiment:
        yield f"next: {experiment['do']}  # {experiment['why']}"


def _list_finding_rows(diagnosis: Diagnosis) -> Iterator[str]:
    for finding in diagnosis.findings:
        sure = {"rest": "mends the model", "set": "one of these"}.get(
            finding.level, f"{finding.level} is sure"
        )
        low, high = finding.interval_nats
        gain = f"gain {finding.gain_nats:.0f} nats ({low:.0f} to {high:.0f})"
        yield f"{spell_finding(diagnosis, finding)}: {sure}; {gain}"
        for rival in finding.judged[:MOST_RIVALS]:
            label = spell_names(label_hypothesis(rival.hypothesis))
            yield f"  {label}: {rival.behind_nats:.0f} nats behind{describe_standing(rival)}"


def _list_number_rows(diagnosis: Diagnosis) -> Iterator[str]:
    found = [n for f in diagnosis.findings for n in list_numbers(f)]
    numbers = [*diagnosis.recalibrated, *found]
    if numbers:
        yield f"{'fitted':<36}{'value':>12}  90 % interval"
    for n in numbers:
        bound = "  (at an end of its range)" if n.name in diagnosis.at_bound else ""
        line = f"{n.name:<36}{n.value:>12.5g}  {n.low:.5g} to {n.high:.5g} {n.unit}".rstrip()
        yield f"{line}{bound}"


def _list_gap_rows(diagnosis: Diagnosis) -> Iterator[str]:
    if not diagnosis.gap:
        return
    of = "held-out gap, RMS" if diagnosis.is_held_out else "gap, RMS"
    yield f"{of:<20}{'start model':>12}{'recalibrated':>14}{'extended':>12}{'noise':>10}"
    for channel, gap in diagnosis.gap.items():
        display = SIGNAL_DISPLAYS[channel]
        a, b, c, d = (f"{display.gap_factor * level:.4g}" for level in gap)
        label = f"{display.short}, {display.gap_unit}"
        yield f"{label:<20}{a:>12}{b:>14}{c:>12}{d:>10}"


def _list_masks(diagnosis: Diagnosis) -> Iterator[str]:
    for channel, share in find_masked_shares(diagnosis).items():
        if share > 0.0:
            yield f"{channel}: {100.0 * share:.2g} % of the samples do not count"
