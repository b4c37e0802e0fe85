"""What every verdict says: title, finding, explanation and advice, one function a verdict.

What is sure of each finding stands in the title: its name, or its kind and place, or its place,
or the set of what it may be. A number at an end of its range stands there too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis, Verdict
from pamctl.diagnose.report.finding_words import spell_names, spell_set
from pamctl.diagnose.report.next_experiment import choose_next_experiment
from pamctl.diagnose.report.open_findings import list_ambiguous, list_faults
from pamctl.diagnose.report.phrases import (
    describe_bounds,
    describe_gap,
    describe_rest,
    describe_sizes,
    list_shifts,
    spell_findings,
)
from pamctl.diagnose.report.rig_at_hand import runs_here, words_of_rig

_ON_RIG = (
    "`pamctl diagnose --on-rig --out decided` runs such programs, one after the other, on the rig "
    "of a running daemon."
)
_RECORD = "pamctl run --experiment diagnosis --set experiment.seed=3 --log next.mcap"
_BY_BLOCKS = (
    "What counts is what an explanation gains on stretches of the records that it was not fitted "
    "to, against all others that could stand in its place."
)
_AGAIN = "`pamctl diagnose next.mcap --plant plant.yaml --out next`"


@dataclass(frozen=True)
class VerdictWords:
    """The words of one verdict, in one case."""

    title: str
    finding: str
    """A few sentences that complete the title on a terminal."""
    explanation: str
    """A few sentences for a reader who was not there."""
    advice: tuple[str, ...]
    """What to do next, the first thing first."""
    kind: str = "note"
    """How the page marks it: `good`, `bad` or `note`."""


def choose_words(diagnosis: Diagnosis) -> VerdictWords:
    """Return the words of the diagnosis's verdict."""
    return _WORDS[diagnosis.verdict](diagnosis)


def sentence(diagnosis: Diagnosis) -> str:
    """Say what was found, in a few sentences."""
    words = choose_words(diagnosis)
    return " ".join(p for p in (f"{words.title}.", _say_setup(diagnosis), words.finding) if p)


def _say_setup(diagnosis: Diagnosis) -> str:
    parts = []
    for fault in list_faults(diagnosis):
        others = spell_set(fault.cannot_be_told_from)
        apart = f" These data cannot tell it from {others}." if others else ""
        parts.append(f"Set-up: {fault.text}.{apart}")
    return " ".join(parts)


def advise_next_steps(diagnosis: Diagnosis) -> Iterator[str]:
    """Say what to do next, the first thing first."""
    yield from choose_words(diagnosis).advice
    yield from (f"Set-up: {fault.how_to_mend}." for fault in list_faults(diagnosis))
    experiment = choose_next_experiment(diagnosis)
    if experiment:
        yield _describe_experiment(experiment, is_command=runs_here(diagnosis))
        done = {"diagnosis"} >= {record.experiment for record in diagnosis.train}
        if diagnosis.deciding is not None and runs_here(diagnosis):
            yield f"Its file is in the folder of this page. {_ON_RIG}"
        elif runs_here(diagnosis) and not done and experiment["name"] != "diagnosis":
            yield f"The experiment `diagnosis` contains them all: `{_RECORD}`."


def _describe_experiment(experiment: Mapping[str, Any], *, is_command: bool) -> str:
    effects = experiment["separates"]
    apart = f", which tells {' from '.join(map(spell_names, effects))}" if len(effects) > 1 else ""
    do = f"`{experiment['do']}`" if is_command else experiment["do"]
    return f"Next experiment: {do}{apart}. Why: {experiment['why']}."


def _join(*sentences: str) -> str:
    return " ".join(s for s in sentences if s)


def _word_bad_data(diagnosis: Diagnosis) -> VerdictWords:
    return VerdictWords(
        "These data cannot be diagnosed",
        diagnosis.reason,
        f"Nothing was fitted, and nothing is concluded. The reason: {diagnosis.reason}",
        (
            "Repair what the reason names. `pamctl log check LOG` examines a log.",
            f"Or record again, starting {words_of_rig(diagnosis).begin}"
            + (f": `{_RECORD}`." if runs_here(diagnosis) else "."),
        ),
        "bad",
    )


def _word_no_discrepancy(diagnosis: Diagnosis) -> VerdictWords:
    gap = describe_gap(diagnosis)
    return VerdictWords(
        f"The model explains the measurement{describe_bounds(diagnosis)}",
        f"Nothing is missing that these data could show. {gap}",
        f"No explanation that was asked gains anything that counts. {_BY_BLOCKS} {gap}",
        ("Go on with the model that you have.",),
        "good",
    )


def _word_miscalibrated(diagnosis: Diagnosis) -> VerdictWords:
    faults = len(list_faults(diagnosis))
    what = "the set-up is not as it is said to be" if faults else "its numbers are off"
    shifts, gap = list_shifts(diagnosis), describe_gap(diagnosis)
    return VerdictWords(
        f"Nothing is missing from the model, but {what}{describe_bounds(diagnosis)}",
        f"Changed: {shifts}. {gap}",
        "With other numbers the model explains the measurement. It needs no further effect. "
        f"Changed: {shifts}. {gap}",
        ("Go on with plant.yaml: the same model with the new numbers.",),
        "good",
    )


def _word_named(diagnosis: Diagnosis) -> VerdictWords:
    names = spell_findings(diagnosis, "name")
    body = _join(describe_sizes(diagnosis), describe_gap(diagnosis), describe_rest(diagnosis))
    return VerdictWords(
        f"Missing from the model: {names}{describe_bounds(diagnosis)}",
        body,
        "The model does not explain the measurement, not even with those values of its own numbers "
        f"that fit best. With {names} it does, and nothing else that was asked does as well. "
        f"{_BY_BLOCKS} {body}",
        (*_advise_calibration(diagnosis), _advise_after_naming(diagnosis)),
        "good",
    )


def _advise_calibration(diagnosis: Diagnosis) -> Iterator[str]:
    if runs_here(diagnosis) and any(f.name == "null_offset" for f in diagnosis.findings):
        yield "The null of the valve is measured by `pamctl calibrate valve --out rig.yaml`."


def _advise_after_naming(diagnosis: Diagnosis) -> str:
    if diagnosis.nominal.actuator != "muscle":
        return f"Go on with plant.yaml, which has what was found: {_AGAIN} asks whether it holds."
    return (
        "Go on with plant.yaml, which has what was found. In the folder of this page: "
        "`pamctl tune --law qsmc --plant plant.yaml --out gains.yaml`, then "
        "`pamctl run --controller gains.yaml --plant plant.yaml`."
    )


def _word_described(diagnosis: Diagnosis) -> VerdictWords:
    what = spell_findings(diagnosis, "kind", "place")
    body = _join(describe_gap(diagnosis), describe_rest(diagnosis))
    return VerdictWords(
        f"Missing from the model, and without a name: {what}{describe_bounds(diagnosis)}",
        body,
        f"What is sure is this much: {what}. No name is: either several laws of that place do as "
        f"well, or a law without a name does better than every effect of the catalogue. {body} "
        "This says where and how something acts. What it is, the rig must show.",
        (
            "Look at the rig at that place. plant.yaml has the law that fits best: it predicts "
            "what was measured, and `pamctl run`, `tune`, `compare` and a next `diagnose` take it.",
        ),
        "good",
    )


def _word_ambiguous(diagnosis: Diagnosis) -> VerdictWords:
    sets = "; and ".join(map(spell_set, list_ambiguous(diagnosis)))
    settled = spell_findings(diagnosis, "name", "kind", "place")
    beside = f" beside {settled}" if settled else ""
    body = _join(describe_sizes(diagnosis), describe_gap(diagnosis), describe_rest(diagnosis))
    return VerdictWords(
        f"Something is missing{beside}, and these data do not tell which it is: {sets}"
        f"{describe_bounds(diagnosis)}",
        body,
        "The model does not explain the measurement with the best values of its own numbers. More "
        f"than one explanation does, at more than one place: {sets}. plant.yaml has the first of "
        f"them. It predicts what was measured. The cause stays open. {body}",
        ("Do not repair the rig on this evidence. Run the experiment that separates them.",),
    )


def _word_partial(diagnosis: Diagnosis) -> VerdictWords:
    names = spell_findings(diagnosis, "name")
    others = spell_findings(diagnosis, "kind", "place")
    has_names = f"{names}; and" if names else "at least"
    body = _join(describe_sizes(diagnosis), describe_gap(diagnosis), describe_rest(diagnosis))
    return VerdictWords(
        f"Missing from the model: {has_names}, without a name, {others}"
        f"{describe_bounds(diagnosis)}",
        body,
        f"Sure by name: {names or 'what is said of the set-up'}. Sure by its place only, or by "
        f"place and kind: {others}. {body} The numbers of what is named rest on the law that "
        "stands for the rest.",
        (
            f"Look at the rig there. plant.yaml has all of it. The next diagnosis may start from "
            f"it: {_AGAIN}.",
        ),
    )


def _word_none_known(diagnosis: Diagnosis) -> VerdictWords:
    gap = describe_gap(diagnosis)
    return VerdictWords(
        f"Something is missing, and nothing that was asked explains it{describe_bounds(diagnosis)}",
        gap,
        "After recalibration, no effect, no fault of the set-up and no law without a name explains "
        f"what is left on stretches that it was not fitted to. {gap}",
        (
            "Look at the residual below, and at the rig: "
            f"{words_of_rig(diagnosis).suspects}. Record the same experiment twice: it shows how "
            "far the rig repeats itself. plant.yaml has the recalibrated numbers.",
        ),
        "bad",
    )


_WORDS: Mapping[Verdict, Callable[[Diagnosis], VerdictWords]] = {
    Verdict.BAD_DATA: _word_bad_data,
    Verdict.NO_DISCREPANCY: _word_no_discrepancy,
    Verdict.MISCALIBRATED: _word_miscalibrated,
    Verdict.NAMED: _word_named,
    Verdict.DESCRIBED: _word_described,
    Verdict.AMBIGUOUS: _word_ambiguous,
    Verdict.PARTIAL: _word_partial,
    Verdict.NONE_KNOWN: _word_none_known,
}
