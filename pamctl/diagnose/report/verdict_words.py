"""What every verdict says: title, body, why and advice."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from pamctl.diagnose.diagnosis import Diagnosis, Verdict
from pamctl.diagnose.report.finding_words import (
    list_ambiguous,
    list_faults,
    spell_set,
)
from pamctl.diagnose.report.next_experiment import (
    NEXT_COMMANDS,
    advise_own_plant,
    choose_next_experiment,
    runs_here,
    tell_apart_surely,
    words_of_rig,
)
from pamctl.diagnose.report.verdict_phrases import (
    describe_bounds,
    describe_gap,
    describe_left,
    describe_moved,
    describe_outside,
    describe_rest,
    describe_sizes,
    describe_unnamed,
    doubt_noise,
    list_places_in_words,
    list_shifts,
    spell_findings,
    spell_unnamed,
)
from pamctl.plant.model import PlantSettings

_ON_RIG = (
    "`pamctl diagnose --on-rig --out decided` runs such programs, one after the other, on the rig "
    "of a running daemon."
)
_RECORD = "pamctl run --experiment diagnosis --set experiment.seed=3 --log next.mcap"
_BY_BLOCKS = (
    "What counts is what an explanation gains on stretches of the records that it was not fitted "
    "to, against all others that could stand in its place."
)
_AGAIN = "`pamctl diagnose next.mcap --plant plant.yaml --out next`, in the folder of this page,"
_AGAIN_ELSEWHERE = (
    "`pamctl diagnose FILE --plant plant.yaml --out next`, in the folder of this page, with your "
    "next record for FILE, and with your `--map` if it needs one,"
)


class VerdictWords(NamedTuple):
    """The words of one verdict, in one case."""

    title: str
    body: str
    """Some sentences with the figures; they complete the title."""
    why: str
    """What the verdict means, for a reader who was not there; it stands before the body."""
    advice: tuple[str, ...]
    """What to do next, the first thing first."""
    kind: str = "good"
    """How the page marks it: `good`, `bad` or `note`."""


def sentence(diagnosis: Diagnosis) -> str:
    """Say what was found, in a few sentences."""
    words = choose_words(diagnosis)
    parts = [f"{words.title}."]
    for fault in list_faults(diagnosis):
        others = spell_set(fault.cannot_be_told_from)
        apart = f" These data cannot tell it from {others}." if others else ""
        parts.append(f"Set-up: {fault.text}.{apart}")
    return " ".join([*parts, words.body]).rstrip()


def choose_words(diagnosis: Diagnosis) -> VerdictWords:
    """Return the words of the diagnosis's verdict.

    What is sure of each finding stands in the title: its name, or its kind and place, or its place,
    or the set of what it may be. A number at an end of its range stands there too.
    """
    names = spell_findings(diagnosis, "name")
    others = spell_unnamed(diagnosis)
    gap, ended = describe_gap(diagnosis), describe_bounds(diagnosis)
    outside = describe_outside(diagnosis)
    part, left = "what a plant file can hold of it" if outside else "", describe_left(diagnosis)
    predicts = "" if part or left else ", which predicts what was measured"
    better = " better" if left else ""
    missing = "More is missing than was found" if left else "Missing from the model"
    look = f"Look at the residual below, and at the rig: {words_of_rig(diagnosis).suspects}."
    runs = "`pamctl run`, `tune`, `compare`"
    takers = runs if _can_run(diagnosis.nominal) else "`pamctl compare`"
    chosen = diagnosis.deciding
    may_separate = chosen is None or chosen.promises
    separates = " Run the experiment that separates them." if may_separate else ""
    again = _AGAIN if runs_here(diagnosis) else _AGAIN_ELSEWHERE
    moved = describe_moved(diagnosis)
    parts = (describe_sizes(diagnosis), moved, gap, describe_rest(diagnosis), outside)
    body = " ".join(part for part in parts if part)
    match diagnosis.verdict:
        case Verdict.BAD_DATA:
            record = f": `{_RECORD}`." if runs_here(diagnosis) else "."
            return VerdictWords(
                "These data cannot be diagnosed",
                diagnosis.reason,
                "Nothing was fitted, and nothing is concluded. The reason:",
                (
                    "Repair what the reason names. `pamctl log check LOG` examines a log.",
                    f"Or record again, starting {words_of_rig(diagnosis).begin}{record}",
                ),
                "bad",
            )
        case Verdict.NO_DISCREPANCY:
            return VerdictWords(
                f"The model explains the measurement{ended}",
                f"Nothing is missing that these data could show. {gap}",
                f"No explanation that was asked gains anything that counts. {_BY_BLOCKS}",
                ("Go on with the model that you have.",),
            )
        case Verdict.MISCALIBRATED:
            faults = list_faults(diagnosis)
            what = "the set-up is not as it is said to be" if faults else "its numbers are off"
            title = f"{what[:1].upper()}{what[1:]}, and that is not all"
            needs = "What is left, nothing that was asked explains"
            if not left:
                title = f"Nothing is missing from the model, but {what}"
                needs = "It needs no further effect"
            return VerdictWords(
                f"{title}{ended}",
                f"Changed: {list_shifts(diagnosis)}. {gap} {outside}".rstrip(),
                f"With other numbers the model explains the measurement{better}. {needs}.",
                (
                    "Go on with plant.yaml: the same model with the new numbers.",
                    *[look] * bool(left),
                ),
                "note" if left else "good",
            )
        case Verdict.NAMED:
            return VerdictWords(
                f"{missing}: {names}{ended}",
                body,
                "The model does not explain the measurement, not even with those values of its own "
                f"numbers that fit best. With {names} it does{better}, and nothing else that was "
                f"asked does as well. {_BY_BLOCKS}",
                _advise_after_naming(diagnosis, again),
            )
        case Verdict.DESCRIBED:
            found = "; of what was asked, most is explained by" if left else ", and without a name:"
            return VerdictWords(
                f"{missing}{found} {others}{ended}{doubt_noise(diagnosis)}",
                body,
                f"No name is sure ({describe_unnamed(diagnosis)}). This says where and how "
                "something acts. What it is, the rig must show.",
                (
                    f"Look at {list_places_in_words(diagnosis)}. plant.yaml has "
                    f"{part or 'the law that fits best'}{predicts}. "
                    f"{takers} and a next `diagnose` take it.",
                ),
            )
        case Verdict.AMBIGUOUS:
            sets = "; and ".join(map(spell_set, list_ambiguous(diagnosis)))
            settled = spell_findings(diagnosis, "name", "kind", "place")
            beside = f" beside {settled}" if settled else ""
            return VerdictWords(
                f"Something is missing{beside}, and these data do not tell which it is: {sets}"
                f"{ended}{doubt_noise(diagnosis)}",
                body,
                "More than one explanation fits as well, at more than one place. "
                f"plant.yaml has {part or 'the first of them'}{predicts}. The cause stays open.",
                (f"Do not repair the rig on this evidence.{separates}",),
                "note",
            )
        case Verdict.PARTIAL:
            has_names = f"{names}; and" if names else "at least"
            return VerdictWords(
                f"{missing}: {has_names}, without a name, {others}{ended}",
                body,
                f"Sure by name: {names or 'what is said of the set-up'}. Of the rest the place is "
                "sure, or place and kind. The numbers of what is named rest on the law that stands "
                "for the rest.",
                (
                    f"Look at {list_places_in_words(diagnosis)}. plant.yaml has "
                    f"{part or 'all of it'}. The next diagnosis may start from it: {again} asks "
                    "what else is missing.",
                ),
                "note",
            )
        case Verdict.NONE_KNOWN:
            return VerdictWords(
                f"Something is missing, and nothing that was asked explains it{ended}",
                f"{gap} {describe_rest(diagnosis)}".rstrip(),
                "After recalibration, no effect, no fault of the set-up and no law without a name "
                "explains what is left on stretches that it was not fitted to.",
                (
                    f"{look} Record the same experiment twice: it shows how far the rig repeats "
                    "itself. plant.yaml has the recalibrated numbers.",
                ),
                "bad",
            )
        case Verdict.INTERRUPTED:
            unjudged = spell_findings(diagnosis, "unjudged")
            added = "what did best was added, and not compared with what looks like it"
            return VerdictWords(
                f"Interrupted; found until then: {unjudged or 'nothing'}{ended}",
                "Nothing is sure: no rival was fitted, and more may be missing. "
                f"{gap} {outside}".rstrip(),
                "The search did not end. The numbers of the model were fitted; "
                f"{added if unjudged else 'nothing was added yet'}.",
                (
                    "Give the same command again, with another folder, and let it end.",
                    "Or go on from plant.yaml, which has the model as far as it came: the same "
                    "command with it for `--plant`, and with another folder, asks what else is "
                    f"missing.{' It takes what was added as given.' if unjudged else ''}",
                ),
                "note",
            )


def advise_next_steps(diagnosis: Diagnosis) -> Iterator[str]:
    """Say what to do next, the first thing first."""
    own = advise_own_plant(diagnosis)
    yield from [f"{own[:1].upper()}{own[1:]}."] if own else []
    yield from choose_words(diagnosis).advice
    yield from (f"Set-up: {fault.how_to_mend}." for fault in list_faults(diagnosis))
    experiment, is_command = choose_next_experiment(diagnosis), runs_here(diagnosis)
    if not experiment:
        return
    apart = f". It {told}" if (told := tell_apart_surely(experiment)) else ""
    do = f"`{experiment['do']}`" if is_command else experiment["do"]
    yield f"Next experiment: {do}{apart}. Why: {experiment['why']}."
    done = {"diagnosis"} >= {record.experiment for record in diagnosis.train}
    if diagnosis.deciding is not None and is_command:
        yield f"Its file is in the folder of this page. {_ON_RIG}"
    elif diagnosis.deciding is not None:
        yield f"The file {NEXT_COMMANDS} is in the folder of this page."
    elif is_command and not done and experiment["name"] != "diagnosis":
        yield f"The experiment `diagnosis` contains them all: `{_RECORD}`."


def _can_run(plant: PlantSettings) -> bool:
    """Tell whether a law of pamctl can move it."""
    return plant.actuator != "chamber" and (plant.actuator != "direct" or bool(plant.drive_n_per_v))


def _advise_after_naming(diagnosis: Diagnosis, again: str) -> tuple[str, ...]:
    plant = diagnosis.nominal
    part = "what a plant file can hold of it" if describe_outside(diagnosis) else "what was found"
    if not _can_run(plant):
        return (f"Go on with plant.yaml, which has {part}: {again} asks whether it holds.",)
    own, steps = "", [
        "`pamctl tune --law qsmc --plant plant.yaml --out gains.yaml`",
        "`pamctl run --controller gains.yaml --plant plant.yaml`",
    ]  # fmt: skip
    if not runs_here(diagnosis):
        law = "qsmc" if plant.actuator == "muscle" else "pid"
        own = " These tune and run a simulation of your rig; `sine` stands for a motion of yours."
        steps = [
            "`pamctl plant rig plant.yaml rig.yaml`",
            f"`pamctl tune --law {law} --plant plant.yaml --rig rig.yaml --experiment sine`",
            "`pamctl run --controller gains.yaml --plant plant.yaml --rig rig.yaml "
            "--experiment sine`",
        ]
    typed = ", then ".join(steps)
    go_on = f"Go on with plant.yaml, which has {part}. In the folder of this page: {typed}.{own}"
    if runs_here(diagnosis) and any(f.name == "null_offset" for f in diagnosis.findings):
        null = "The null of the valve is measured by `pamctl calibrate valve --out rig.yaml`."
        return null, go_on
    return (go_on,)
