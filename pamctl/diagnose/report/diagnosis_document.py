"""The diagnosis for programs, for a terminal, and as a folder of files."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import starmap
from typing import Any

from pamctl.base.errors import Problem
from pamctl.diagnose.diagnosis import Diagnosis, Verdict
from pamctl.diagnose.evidence.ladder import Finding, JudgedRival
from pamctl.diagnose.evidence.run_pieces import HELD_OUT, TWELFTHS, Runs
from pamctl.diagnose.record import group_notes
from pamctl.diagnose.report.finding_words import (
    describe_standing,
    find_form,
    label_hypothesis,
    list_ambiguous,
    list_effects,
    list_faults,
    list_fitted,
    list_numbers,
    list_places,
    list_terms,
    spell_finding,
    spell_names,
)
from pamctl.diagnose.report.next_experiment import (
    advise_own_plant,
    choose_next_experiment,
    list_blind_spots,
    spell_next,
)
from pamctl.diagnose.report.verdict_phrases import (
    describe_data,
    relative_shift,
    spell_end,
    spell_gap,
)
from pamctl.diagnose.report.verdict_words import choose_words, sentence
from pamctl.plant.catalogue import CATALOGUE
from pamctl.report.report import Part, Points, Problems, Report, ReportTable, Section, Text

SCHEMA = 2


def build_diagnosis_document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the document as plain values."""
    bad = diagnosis.verdict is Verdict.BAD_DATA
    return {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict.value,
        "sentence": sentence(diagnosis),
        **({"reason": diagnosis.reason} if bad else {}),
        "setup": [fault._asdict() for fault in list_faults(diagnosis)],
        "effects": [_describe_effect(diagnosis, f) for f in list_effects(diagnosis)],
        "terms": list_terms(diagnosis),
        "places": list_places(diagnosis),
        "ambiguous": list_ambiguous(diagnosis),
        "findings": [_describe_finding(diagnosis, f) for f in diagnosis.findings],
        "recalibrated": {
            n.name: {
                **n.as_dict(),
                "start": diagnosis.start_value(n.name),
                "off_by": relative_shift(diagnosis, n),
            }
            for n in diagnosis.recalibrated
        },
        "at_bound": [*diagnosis.at_bound],
        "gap": {name: gap._asdict() for name, gap in diagnosis.gap.items()},
        "explained": diagnosis.explained,
        "unexplained": dict(diagnosis.evidence.left_over_noise) if diagnosis.evidence else {},
        "confirmed_on": None if bad else _describe_confirmation(diagnosis),
        "masked": find_masked_shares(diagnosis),
        "blind_spots": list_blind_spots(diagnosis),
        "next_experiment": choose_next_experiment(diagnosis),
        "forecasts": [judged.as_dict() for judged in diagnosis.forecasts],
        "notes": group_notes((*diagnosis.train, *diagnosis.holdout)),
        "accepted": [doubt.as_dict() for doubt in diagnosis.accepted],
        "noise": {name: about.as_dict(name) for name, about in diagnosis.noise.items()},
    }


def _describe_effect(diagnosis: Diagnosis, finding: Finding) -> dict[str, Any]:
    name = finding.hypothesis.family
    others = [j for j in finding.judged if not j.is_freer]
    return {
        "name": name,
        "block": CATALOGUE[name].block,
        "form": find_form(diagnosis, finding),
        "parameters": {n.name.split(".")[1]: n.as_dict() for n in list_numbers(finding)},
        "rivals": [_describe_rival(j) for j in finding.judged],
        "confidence": min((j.loses for j in others), default=1.0),
    }


def _describe_rival(judged: JudgedRival) -> dict[str, Any]:
    return {
        "name": label_hypothesis(judged.hypothesis),
        "behind_nats": judged.behind_nats,
        "interval_nats": [*judged.interval_nats],
        "is_beaten": judged.is_beaten,
        "is_freer": judged.is_freer,
        "idle_numbers": judged.idle_numbers,
    }


def _describe_finding(diagnosis: Diagnosis, finding: Finding) -> dict[str, Any]:
    its = finding.hypothesis
    return {
        "name": label_hypothesis(its),
        "place": its.place,
        "kind": its.kind,
        "level": finding.level,
        "text": spell_finding(diagnosis, finding),
        "gain_nats": finding.gain_nats,
        "interval_nats": [*finding.interval_nats],
        "share": finding.share,
        "numbers": {n.name: n.as_dict() for n in list_numbers(finding)},
        "at_range": [*finding.at_range],
        "rivals": [_describe_rival(j) for j in finding.judged if not j.is_beaten],
    }


def _describe_confirmation(diagnosis: Diagnosis) -> dict[str, Any]:
    records, share = diagnosis.holdout or diagnosis.train, 1.0
    how = "records that were not fitted" if diagnosis.holdout else "the fitted records"
    if diagnosis.is_held_out and not diagnosis.holdout:
        how = "two stretches of each record that were not fitted"
        share = len(HELD_OUT) / TWELFTHS
    return {
        "records": [r.name for r in records],
        "duration_s": share * sum(r.duration_s for r in records),
        "how": how,
    }


def find_masked_shares(diagnosis: Diagnosis) -> dict[str, float]:
    """Return the share of each channel's samples that do not count."""
    if diagnosis.evidence is None:
        return {}
    weigher = diagnosis.evidence.weigher
    runs: list[Runs] = [r for r in (weigher.train, weigher.held_out) if r is not None]
    masked = sum(r.masked.sum(axis=(1, 2)) for r in runs)
    samples = sum(r.masked[0].size for r in runs)
    return {c: float(m / samples) for c, m in zip(runs[0].channels, masked, strict=True)}


MOST_RIVALS = 3
_SURE = {"rest": "mends the model", "set": "one of these", "unjudged": "not judged"}


def report_diagnosis(diagnosis: Diagnosis) -> Report:
    """Return the answer for a terminal: the sentence, then what it rests on."""
    report = Report(
        "Diagnosis",
        f"{diagnosis.verdict.value}: {sentence(diagnosis)}",
        document=build_diagnosis_document(diagnosis),
    )
    faults = list_faults(diagnosis)
    if faults:
        report.add(
            Section("set-up"),
            Problems([Problem("", f.number, f.text, "warning", fix=f.how_to_mend) for f in faults]),
        )
    if diagnosis.findings:
        report.add(Section("what was found"))
    for finding in diagnosis.findings:
        report.add(*_report_finding(diagnosis, finding))
    report.add(*_report_numbers(diagnosis), *_report_gap(diagnosis))
    masked = [
        f"{channel}: {100.0 * share:.2g} % of the samples do not count: gaps, spikes, a frozen "
        "sensor, the first moments of a stretch, or a drive's rests and reversals"
        for channel, share in find_masked_shares(diagnosis).items()
        if share > 0.0
    ]
    accepted = [
        f"accepted ({a.rule}): {a.reason}: {'; '.join(a.doubts)}" for a in diagnosis.accepted
    ]
    notes = [*masked, *describe_data(diagnosis), *accepted]
    if notes:
        report.add(Section("about the data"), Points(notes))
    experiment, own = choose_next_experiment(diagnosis), advise_own_plant(diagnosis)
    if own:
        report.add(Text(f"first: {own}"))
    if diagnosis.verdict is Verdict.INTERRUPTED:
        report.add(*map(Text, choose_words(diagnosis).advice))
    if experiment:
        report.add(Text(spell_next(experiment)))
    return report


def _report_finding(diagnosis: Diagnosis, finding: Finding) -> Iterator[Part]:
    sure = _SURE.get(finding.level, f"{finding.level} is sure")
    low, high = finding.interval_nats
    gain = f"gain {finding.gain_nats:.0f} nats ({low:.0f} to {high:.0f})"
    yield Text(f"{spell_finding(diagnosis, finding)}: {sure}; {gain}")
    rivals = [(label_hypothesis(j.hypothesis), j) for j in finding.judged[:MOST_RIVALS]]
    yield Points([f"{spell_names(label)}: {describe_standing(j)}" for label, j in rivals])


def _report_numbers(diagnosis: Diagnosis) -> Iterator[Part]:
    own = {n.name: f"{diagnosis.start_value(n.name):.4g}" for n in diagnosis.recalibrated}
    rows = [
        [
            n.name, own.get(n.name, ""), *n.spell(),
            spell_end(diagnosis, n.name),
        ]
        for n in list_fitted(diagnosis)
    ]  # fmt: skip
    if rows:
        yield ReportTable(["fitted", "was", "value", "90 % interval", "unit", "range"], rows)


def _report_gap(diagnosis: Diagnosis) -> Iterator[Part]:
    gaps = starmap(spell_gap, diagnosis.gap.items())
    rows = [[f"{name}, {unit}", *levels] for name, unit, *levels in gaps]
    if rows:
        of = "held-out gap, RMS" if diagnosis.is_held_out else "gap, RMS"
        yield ReportTable([of, "start model", "recalibrated", "extended", "noise"], rows)
