"""What every verdict says: title, body, why and advice; and the phrases that they share."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import starmap
from typing import NamedTuple

from pamctl.diagnose.diagnosis import Diagnosis, HeldOutGap, Verdict
from pamctl.diagnose.evidence.constants import LEFT_TIMES
from pamctl.diagnose.evidence.ladder import Doubt, Finding
from pamctl.diagnose.evidence.pool import CHAIN
from pamctl.diagnose.plant_numbers import FittedNumber
from pamctl.diagnose.report.finding_words import (
    label_hypothesis,
    list_ambiguous,
    list_faults,
    list_numbers,
    spell_best,
    spell_finding,
    spell_names,
    spell_place,
    spell_set,
)
from pamctl.diagnose.report.next_experiment import (
    NEXT_COMMANDS,
    advise_own_plant,
    choose_next_experiment,
    name_apart,
    runs_here,
    words_of_rig,
)
from pamctl.plant.model import PlantSettings
from pamctl.report.report import SIGNAL_DISPLAYS, spell_figure

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

_DOUBTS: dict[Doubt, str] = {
    "": "nothing speaks against its name",
    "law": "a law without a name fits best",
    "open": "{} is not ruled out",
    "freer": "a law without a name does better",
    "range": "a number of it stands at an end of its range",
    "none": "its interval holds the value at which it does nothing",
    "part": "a law without a name is missing at its place too, and this may be a part of it",
    "little": "it takes off little of what is left there, and may be a part of that",
    "larger": "a larger finding in the same signal has no name, and this may be a part of it",
}
"""Why a finding has no sure name."""


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
    part = "what a plant file can hold of it" if outside else ""
    predicts = "" if part or describe_left(diagnosis) else ", which predicts what was measured"
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
            return VerdictWords(
                f"Nothing is missing from the model, but {what}{ended}",
                f"Changed: {list_shifts(diagnosis)}. {gap} {outside}".rstrip(),
                "With other numbers the model explains the measurement. It needs no further "
                "effect.",
                ("Go on with plant.yaml: the same model with the new numbers.",),
            )
        case Verdict.NAMED:
            return VerdictWords(
                f"Missing from the model: {names}{ended}",
                body,
                "The model does not explain the measurement, not even with those values of its own "
                f"numbers that fit best. With {names} it does, and nothing else that was asked "
                f"does as well. {_BY_BLOCKS}",
                _advise_after_naming(diagnosis, again),
            )
        case Verdict.DESCRIBED:
            return VerdictWords(
                f"Missing from the model, and without a name: {others}{ended}",
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
                f"{ended}",
                body,
                "More than one explanation fits the measurement, at more than one place. "
                f"plant.yaml has {part or 'the first of them'}{predicts}. The cause stays open.",
                (f"Do not repair the rig on this evidence.{separates}",),
                "note",
            )
        case Verdict.PARTIAL:
            has_names = f"{names}; and" if names else "at least"
            return VerdictWords(
                f"Missing from the model: {has_names}, without a name, {others}{ended}",
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
                gap,
                "After recalibration, no effect, no fault of the set-up and no law without a name "
                "explains what is left on stretches that it was not fitted to.",
                (
                    "Look at the residual below, and at the rig: "
                    f"{words_of_rig(diagnosis).suspects}. Record the same experiment twice: it "
                    "shows how far the rig repeats itself. plant.yaml has the recalibrated "
                    "numbers.",
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
                    "Give the same command again, with another folder, and let it end. plant.yaml "
                    "has the model as far as it came.",
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
    effects = experiment["separates"]
    apart = f", which tells {name_apart(effects)}" if len(effects) > 1 else ""
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


# --- phrases with numbers: a figure is one of the document, in the unit of a reader --------------

LEAST_SHIFT = 2e-3
"""A number that is off by a smaller share is not mentioned in a sentence."""


def join_words(parts: list[str]) -> str:
    """Return `a, b and c`."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def spell_number(number: FittedNumber) -> str:
    """Return a fitted number in one line: `fill_width_v 0.25 V (90 %: 0.249 to 0.251)`."""
    name = number.name.removeprefix(CHAIN).split(".")[-1]
    value, interval, unit = number.spell()
    return f"{name} {f'{value} {unit}'.rstrip()} (90 %: {interval})"


def spell_findings(diagnosis: Diagnosis, *levels: str) -> str:
    """Return the findings of these levels as a list of nouns."""
    return join_words(
        [
            spell_finding(diagnosis, f)
            for f in diagnosis.findings
            if f.level in levels and (f.level != "name" or f.hypothesis.setup is None)
        ]
        or [""]
    )


MOST_DESCRIBED = 2
"""Findings without a name that a title describes; of more it has the places."""


def spell_unnamed(diagnosis: Diagnosis) -> str:
    """Return the findings without a name as nouns; where they are, if they are many."""
    if len(_list_unnamed(diagnosis)) <= MOST_DESCRIBED:
        return spell_findings(diagnosis, "kind", "place")
    return f"something in {list_places_in_words(diagnosis)}"


def list_places_in_words(diagnosis: Diagnosis) -> str:
    """Return the places of what has no name, the first found first."""
    places = (spell_place(f.hypothesis.place) for f in _list_unnamed(diagnosis))
    return join_words([*dict.fromkeys(places)])


def _list_unnamed(diagnosis: Diagnosis) -> list[Finding]:
    return [f for f in diagnosis.findings if f.level in ("kind", "place")]


def describe_sizes(diagnosis: Diagnosis) -> str:
    """Return the numbers of the named effects; empty where none is named."""
    parts = [
        f"{spell_names(f.hypothesis.family)}: {', '.join(map(spell_number, list_numbers(f)))}"
        for f in diagnosis.findings
        if f.level == "name" and f.hypothesis.setup is None
    ]
    return f"{'; '.join(parts)}." if parts else ""


def describe_bounds(diagnosis: Diagnosis) -> str:
    """Name the numbers at an end of their range, but of what only mends; empty where none is."""
    only_mends = {n.name for f in diagnosis.findings if f.level == "rest" for n in f.numbers}
    ended = [n for n in diagnosis.at_bound if n not in only_mends]
    if not ended:
        return ""
    at = join_words([f"{n.removeprefix(CHAIN)} {spell_end(diagnosis, n)}" for n in ended])
    return f", with {at} of {'its range' if len(ended) == 1 else 'their ranges'}"


def spell_end(diagnosis: Diagnosis, name: str) -> str:
    """Say at which end of its range a fitted number stands; empty where at none."""
    if name not in diagnosis.at_bound or diagnosis.evidence is None:
        return ""
    m = diagnosis.evidence.model
    ends = (v - n.low > n.high - v for n, v in zip(m.numbers, m.x, strict=True) if n.name == name)
    return "at the high end" if next(ends, False) else "at the low end"


def spell_gap(channel: str, gap: HeldOutGap) -> list[str]:
    """Return the channel, its unit, what three models leave, and the noise of its sensor."""
    display = SIGNAL_DISPLAYS[channel]
    factor, unit = display.choose_unit(max(gap[:3]))
    return [display.short, unit, *(spell_figure(factor * rms) for rms in (*gap[:3], gap.floor))]


def describe_gap(diagnosis: Diagnosis) -> str:
    """Say what each model leaves of each channel, in plain units, and whether that is noise."""
    evidence, parts = diagnosis.evidence, []
    is_windowed = evidence and evidence.weigher.train.windowed
    begins = ", and of the readings that windows begin from," if is_windowed else ""
    for name, unit, start, again, extended, noise in starmap(spell_gap, diagnosis.gap.items()):
        steps = [f"{start} {unit} by the start model", f"{again} {unit} recalibrated"]
        if diagnosis.findings:
            steps.append(f"{extended} {unit} with what was found")
        parts.append(f"{name} {', '.join(steps)} (noise of its sensor{begins} {noise} {unit})")
    where = "On held-out seconds" if diagnosis.is_held_out else "On the fitted records"
    said = f"{where} the RMS that is left is: {'; '.join(parts)}."
    return f"{said} {describe_left(diagnosis)}".rstrip()


def describe_left(diagnosis: Diagnosis) -> str:
    """Say of which channels more is left than noise; empty where nothing is."""
    left = diagnosis.evidence.left_over_noise if diagnosis.evidence else {}
    high = [
        f"{spell_figure(times)} times the noise of its sensor in the {SIGNAL_DISPLAYS[c].short}"
        for c, times in left.items()
        if times > LEFT_TIMES
    ]
    if not high:
        return ""
    return (
        f"That is still {join_words(high)}: more is missing, or the rig does not repeat itself "
        "any better."
    )


def describe_rest(diagnosis: Diagnosis) -> str:
    """Say that small findings mend the model and are not said; empty where there are none."""
    rest = sum(f.level == "rest" for f in diagnosis.findings)
    if not rest:
        return ""
    more = "One more law mends" if rest == 1 else "Further laws mend"
    return f"{more} what is left a little; too small to be a finding beside the first."


def describe_outside(diagnosis: Diagnosis) -> str:
    """Say what was found between the plant and the file: no key of plant.yaml holds it."""
    outside = [
        spell_finding(diagnosis, f)
        for f in diagnosis.findings
        if f.hypothesis.setup and f.hypothesis.setup[0] != "plant_constant"
        and all(n.name.startswith(CHAIN) for n in f.numbers)
    ]  # fmt: skip
    if not outside:
        return ""
    knows = "what runs or tunes on that file knows nothing of it"
    return f"No key of plant.yaml holds {join_words(outside)}: {knows}."


def describe_unnamed(diagnosis: Diagnosis) -> str:
    """Say of each finding without a name why it has none; of many, where it is said."""
    found = _list_unnamed(diagnosis)
    if len(found) > MOST_DESCRIBED:
        return "what was found, one by one, stands below"
    return "; ".join(f"{spell_best(f)}: {explain_no_name(f)}" for f in found)


def explain_no_name(finding: Finding) -> str:
    """Say why a finding has no sure name."""
    return _DOUBTS[finding.doubt].format(spell_set([*map(label_hypothesis, finding.rivals)]))


def relative_shift(diagnosis: Diagnosis, number: FittedNumber) -> float | None:
    """Return by which share a recalibrated number is off; None where its interval allows 0."""
    nominal = diagnosis.start_value(number.name)
    if number.low <= nominal <= number.high or nominal == 0.0:
        return None
    return number.value / nominal - 1.0


MUCH = 0.2
"""A number of the start model that is off by a larger share stands in every verdict."""


def describe_moved(diagnosis: Diagnosis) -> str:
    """Say which numbers of the start model are far off; empty where none is."""
    shifts = [(abs(relative_shift(diagnosis, n) or 0.0), n) for n in diagnosis.recalibrated]
    moved = sorted((s for s in shifts if s[0] > MUCH), key=lambda s: -s[0])
    listed = [
        f"{n.name} is {spell_figure(n.value)}{f' {n.unit}' if n.unit else ''} and not "
        f"{spell_figure(diagnosis.start_value(n.name))}"
        for _, n in moved
    ]
    return f"Of the start model's numbers, {join_words(listed)}." if listed else ""


def list_shifts(diagnosis: Diagnosis) -> str:
    """Return the numbers of the start model that are off, the largest change first."""
    shifts = [(relative_shift(diagnosis, n) or 0.0, n.name) for n in diagnosis.recalibrated]
    moved = sorted((s for s in shifts if abs(s[0]) > LEAST_SHIFT), key=lambda s: -abs(s[0]))
    listed = ", ".join(f"{name} {100.0 * shift:+.1f} %" for shift, name in moved)
    return listed or f"no number by more than {100.0 * LEAST_SHIFT:.1f} %"


def describe_noise(diagnosis: Diagnosis) -> list[str]:
    """Say which channels have faults, a line each."""
    return [fault.says for about in diagnosis.noise.values() for fault in about.faults]
