"""What every verdict says: title, finding, explanation and advice, one function a verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.next_experiment import choose_next_experiment
from pamctl.diagnose.report.phrases import (
    describe_bounds,
    describe_closed_shares,
    describe_effects,
    describe_largest_remainder,
    describe_signs,
    format_interval,
    list_sets,
    list_shifts,
    list_sizes,
    spell_effects,
    spell_names,
    spell_settled_effects,
)
from pamctl.diagnose.report.rig_at_hand import runs_here, words_of_rig
from pamctl.diagnose.report.setup_part import describe_setup
from pamctl.diagnose.report.term_phrases import (
    describe_equals,
    describe_kin,
    describe_leads,
    find_term,
)

_ON_RIG = (
    "`pamctl diagnose --on-rig --out decided` runs such programs, one after the other, on the rig "
    "of a running daemon."
)
_RECORD = "pamctl run --experiment diagnosis --set experiment.seed=3 --log next.mcap"


@dataclass(frozen=True)
class VerdictWords:
    """The words of one verdict, in one case."""

    title: str
    finding: str
    """One or two sentences that complete the title on a terminal."""
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
    """Say what was found, in two or three sentences."""
    words = choose_words(diagnosis)
    setup = describe_setup(diagnosis)
    return f"{setup}{words.title}. {words.finding}"


def advise_next_steps(diagnosis: Diagnosis) -> Iterator[str]:
    """Say what to do next, the first thing first."""
    yield from choose_words(diagnosis).advice
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
    return VerdictWords(
        "The model explains the measurement",
        "What is left is sensor noise; nothing is missing.",
        "The start model leaves no more than it leaves on data that it generated itself: sensor "
        "noise. Nothing is missing that these data could show.",
        ("Go on with the model that you have.",),
        "good",
    )


def _word_miscalibrated(diagnosis: Diagnosis) -> VerdictWords:
    shifts = list_shifts(diagnosis)
    return VerdictWords(
        "Nothing is missing from the model, but its numbers are off",
        f"Changed: {shifts}.",
        "With other numbers the model leaves no more than sensor noise. It needs no further "
        f"effect. Changed: {shifts}.",
        ("Go on with plant.yaml: the same model with the new numbers.",),
        "good",
    )


def _word_named(diagnosis: Diagnosis) -> VerdictWords:
    names = spell_effects(diagnosis)
    return VerdictWords(
        f"Missing from the model: {names}",
        f"With {describe_effects(diagnosis)} the residual is at the noise floor.",
        "The model does not explain the measurement, not even with those values of its own numbers "
        f"that fit best. With {names} it explains the measurement down to the sensor noise. "
        f"Size: {list_sizes(diagnosis)}.",
        (_advise_after_naming(diagnosis),),
        "good",
    )


def _advise_after_naming(diagnosis: Diagnosis) -> str:
    if diagnosis.nominal.actuator != "muscle":
        return (
            "Go on with plant.yaml, which has the effect: "
            "`pamctl diagnose next.mcap --plant plant.yaml --out next` asks whether it holds."
        )
    return (
        "Go on with plant.yaml, which has the effect. In the folder of this page: "
        "`pamctl tune --law qsmc --plant plant.yaml --out gains.yaml`, then "
        "`pamctl run --controller gains.yaml --plant plant.yaml`."
    )


def _word_ambiguous(diagnosis: Diagnosis) -> VerdictWords:
    sets = f"{list_sets(diagnosis)}, or something that the catalogue does not have"
    settled = spell_settled_effects(diagnosis)
    beside = f" beside {settled}" if settled else ""
    return VerdictWords(
        f"Something is missing{beside}, and these data do not tell what: {sets}",
        f"Best so far: {describe_effects(diagnosis)}.{describe_bounds(diagnosis)}",
        "The model does not explain the measurement with the best values of its own numbers. More "
        f"than one effect explains it as well: {sets}. plant.yaml has the best fit, "
        f"{spell_effects(diagnosis)} ({list_sizes(diagnosis)}). It predicts what was measured. The "
        "cause stays open until the experiment below has been run.",
        ("Do not repair the rig on this evidence. Run the experiment that separates them.",),
    )


def _word_partial(diagnosis: Diagnosis) -> VerdictWords:
    names = spell_effects(diagnosis)
    closes = describe_closed_shares(diagnosis)
    left = describe_signs(diagnosis) if diagnosis.signs else describe_largest_remainder(diagnosis)
    bounds = describe_bounds(diagnosis)
    return VerdictWords(
        f"Explained in part: at least {names}; something else is left",
        f"{describe_effects(diagnosis)} {closes}. {left}{bounds} Take the name as a lead.",
        f"{names[:1].upper()}{names[1:]} {closes} ({list_sizes(diagnosis)}), and no other effect "
        f"of the catalogue does as well. Something else is missing too. {left}{bounds} Take the "
        "name as a lead, not as a finding: what is left may change the numbers, and the name.",
        (
            "plant.yaml predicts better than the start model. Use it where that is enough. The "
            "next diagnosis may start from it: "
            "`pamctl diagnose next.mcap --plant plant.yaml --out next`.",
        ),
    )


def _word_described(diagnosis: Diagnosis) -> VerdictWords:
    term = find_term(diagnosis)
    if term is None:
        return _word_none_known(diagnosis)
    closes = describe_closed_shares(diagnosis)
    names = spell_effects(diagnosis)
    beside = f" Beside it, the catalogue explains a part: {names}." if names else ""
    left = (
        ""
        if diagnosis.model and diagnosis.model.is_complete
        else (f" {describe_largest_remainder(diagnosis)}")
    )
    equals = describe_equals(term)
    numbers = ", ".join(
        f"{n.name.split('.')[1]} {n.value:.4g} (90 %: {format_interval(n.low, n.high)})"
        for n in term.numbers
    )
    return VerdictWords(
        f"Missing from the model, and in no catalogue: {term.text}{describe_kin(term)}",
        f"It {closes}.{equals}{beside}{left}",
        f"No effect of the catalogue explains what is left. {term.text[:1].upper()}"
        f"{term.text[1:]} does: it {closes}, also on records that did not choose it. Its equation: "
        f"{term.equation}; {numbers}.{equals}{beside}{left} This says where and how something "
        "acts. What it is, the rig must show.",
        (
            "Look at the rig at that place. plant.yaml has the term, under `terms:`: it predicts "
            "what was measured, and `pamctl run`, `tune`, `compare` and a next `diagnose` take it.",
        ),
        "good",
    )


def _word_none_known(diagnosis: Diagnosis) -> VerdictWords:
    if diagnosis.signs:
        return _word_signs(diagnosis)
    left = f"{describe_largest_remainder(diagnosis)} {describe_leads(diagnosis)}".rstrip()
    advice = (
        f"Look where the maps below are bright, and at the rig: {words_of_rig(diagnosis).suspects}."
        " plant.yaml has the recalibrated numbers, and no effect."
    )
    return VerdictWords(
        "Something is missing, and it is none of the known effects",
        left,
        "After recalibration, no effect of the catalogue, alone or with others, explains what is "
        f"left. {left} It has a shape, drawn below, but no name.",
        (advice,),
        "bad",
    )


def _word_signs(diagnosis: Diagnosis) -> VerdictWords:
    """Return the words where the residual is at its limit, and the limit is in doubt."""
    seen = describe_signs(diagnosis)
    return VerdictWords(
        "The noise is in doubt, so nothing can be said of the model",
        seen,
        f"{seen} So the estimate of the noise is too large, or the data that confirm differ from "
        "those that chose. No effect is named on this ground.",
        (
            "Record at least 2 s at rest, or state the sensor's noise, and record the same "
            "experiment twice. Then diagnose again.",
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
