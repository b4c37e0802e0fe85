"""Phrases of verdicts, whose figures are those of the document, in the unit of a reader."""

from __future__ import annotations

from itertools import starmap

from pamctl.diagnose.diagnosis import Diagnosis, HeldOutGap
from pamctl.diagnose.evidence.constants import LEFT_TIMES
from pamctl.diagnose.evidence.ladder import Doubt, Finding
from pamctl.diagnose.evidence.pool import CHAIN
from pamctl.diagnose.evidence.run_pieces import Runs
from pamctl.diagnose.plant_numbers import FittedNumber
from pamctl.diagnose.report.finding_words import (
    label_hypothesis,
    list_numbers,
    spell_best,
    spell_finding,
    spell_names,
    spell_place,
    spell_set,
)
from pamctl.log.schema import unit_of_column
from pamctl.report.report import SIGNAL_DISPLAYS, spell_figure

IMPOSED = (
    "force_n does not show the acceleration of position_m: something else moves this axis, and the "
    "model gives the force for the measured motion; if the force moves it, record quicker motions"
)
_DOUBTS: dict[Doubt, str] = {
    "": "nothing speaks against its name",
    "law": "a law without a name fits best",
    "open": "{} is not ruled out",
    "freer": "a law without a name does better",
    "range": "a number of it stands at an end of its range",
    "none": "its interval holds the value at which it does nothing",
    "part": "a law without a name is missing at its place too, and this may be a part of it",
    "little": "much stays unexplained beside what it takes off, and it may be a part of that",
    "larger": "a larger finding in the same signal has no name, and this may be a part of it",
}
"""Why a finding has no sure name."""
_ONLY_MENDS = {
    False: "what gains less than a tenth of the whole is not asked for its name",
    True: "a name is not sure, as little of what is left goes with it, or a law that was not asked "
    "may stand there",
}
"""Why no more is said of what mends the model, by whether rivals were fitted."""
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


_ABSENT = {
    "stiffness_n_per_m": "no spring",
    "damping_n_s_per_m": "no damping",
    "kinetic_friction_per_m": "no friction of the braid",
}
"""What it means that a number may be 0, and stands at the low end of its range."""


def describe_bounds(diagnosis: Diagnosis) -> str:
    """Name the numbers at an end of their range, but of what only mends; empty where none is."""
    only_mends = {n.name for f in diagnosis.findings if f.level == "rest" for n in f.numbers}
    ends = {n: spell_end(diagnosis, n) for n in diagnosis.at_bound if n not in only_mends}
    ended = [f"{n.removeprefix(CHAIN)} {e}" for n, e in ends.items() if e != _ABSENT.get(n)]
    said = [f"{n} as good as 0: {e}" for n, e in ends.items() if e == _ABSENT.get(n)]
    if ended:
        ranges = "its range" if len(ended) == 1 else "their ranges"
        said.insert(0, f"{join_words(ended)} of {ranges}")
    return f", with {join_words(said)}" if said else ""


def spell_end(diagnosis: Diagnosis, name: str) -> str:
    """Say at which end of its range a fitted number stands, or what is absent; empty otherwise."""
    if name not in diagnosis.at_bound or diagnosis.evidence is None:
        return ""
    m = diagnosis.evidence.model
    ends = (v - n.low > n.high - v for n, v in zip(m.numbers, m.x, strict=True) if n.name == name)
    if next(ends, False):
        return "at the high end"
    may_be_0 = any(n.name == name and n.low <= 0.0 for n in diagnosis.recalibrated)
    return (may_be_0 and _ABSENT.get(name)) or "at the low end"


def spell_gap(channel: str, gap: HeldOutGap) -> list[str]:
    """Return the channel, its unit, what three models leave, and the noise of its sensor."""
    display = SIGNAL_DISPLAYS[channel]
    factor, unit = display.choose_unit(max(gap[:3]))
    return [display.short, unit, *(spell_figure(factor * rms) for rms in (*gap[:3], gap.floor))]


def describe_gap(diagnosis: Diagnosis) -> str:
    """Say what each model leaves of each channel, in plain units, and whether that is noise."""
    evidence, parts = diagnosis.evidence, []
    more = list_further_noise(evidence.weigher.train) if evidence else []
    begins = f", and of {join_words(more)}," if more else ""
    for name, unit, start, again, extended, noise in starmap(spell_gap, diagnosis.gap.items()):
        steps = [f"{start} {unit} by the start model", f"{again} {unit} recalibrated"]
        if diagnosis.findings:
            steps.append(f"{extended} {unit} with what was found")
        parts.append(f"{name} {', '.join(steps)} (noise of its sensor{begins} {noise} {unit})")
    where = "On held-out seconds" if diagnosis.is_held_out else "On the fitted records"
    said = f"{where} the RMS that is left is: {'; '.join(parts)}."
    parts = [said, describe_left(diagnosis), _describe_enough_noise(diagnosis)]
    return " ".join(part for part in parts if part)


def list_further_noise(runs: Runs) -> list[str]:
    """Return what else than its sensor makes a channel noisy that a perfect model explains."""
    drivers = [f"the measured {c.split('_')[0]} that drives the model" for c in runs.drivers]
    return [*drivers, *["the readings that windows begin from"] * runs.windowed]


def describe_left(diagnosis: Diagnosis) -> str:
    """Say of which channels more is left than noise; empty where nothing is."""
    left = diagnosis.evidence.left_over_noise if diagnosis.evidence else {}
    high = [
        f"{spell_figure(times)} times that noise in the {SIGNAL_DISPLAYS[c].short}"
        for c, times in left.items()
        if times > LEFT_TIMES
    ]
    if not high:
        return ""
    return (
        f"That is still {join_words(high)}: more is missing, or the rig does not repeat itself any "
        "better."
    )


def doubt_noise(diagnosis: Diagnosis) -> str:
    """Say that what was found may be noise of what drives the model, if nothing more is left."""
    enough = diagnosis.evidence.enough_noise if diagnosis.evidence else {}
    may_be = [f"slow noise of the measured {column.split('_')[0]}" for column in enough]
    is_all = may_be and not describe_left(diagnosis)
    return f", if it is not {' or '.join(may_be)}" if is_all else ""


def _describe_enough_noise(diagnosis: Diagnosis) -> str:
    """Say what noise of what drives the model would leave as much; empty where none would."""
    enough = diagnosis.evidence.enough_noise if diagnosis.evidence else {}
    return " ".join(
        f"Or the sensor of the measured {column.split('_')[0]}, which drives the model, has slow "
        f"noise of about {sigma:.2g} {unit_of_column(column)}: if it may, "
        f"`--noise {column}={sigma:.2g}` states it."
        for column, sigma in enough.items()
    )


def describe_rest(diagnosis: Diagnosis) -> str:
    """Say what only mends the model, and why no more is said of it; empty where nothing does."""
    parts = []
    for is_judged, why in _ONLY_MENDS.items():
        rest = [f for f in diagnosis.findings if f.level == "rest" and is_judged == bool(f.judged)]
        if rest:
            mend = "mends" if len(rest) == 1 else "mend"
            parts.append(
                f"Beside that, {join_words([*map(spell_best, rest)])} {mend} the model: {why}."
            )
    return " ".join(parts)


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


NEAR_0 = 0.1
"""What is known no better than to this share of itself, and may have either sign, is near 0."""


def relative_shift(diagnosis: Diagnosis, number: FittedNumber) -> float | None:
    """Return by which share a number is off; None where its interval allows 0, or it is near 0."""
    if not _is_off(diagnosis, number) or _is_near_0(diagnosis, number):
        return None
    return number.value / diagnosis.start_value(number.name) - 1.0


def _is_off(diagnosis: Diagnosis, number: FittedNumber) -> bool:
    return not number.low <= diagnosis.start_value(number.name) <= number.high


def _is_near_0(diagnosis: Diagnosis, number: FittedNumber) -> bool:
    """Tell whether a share of a number says nothing."""
    numbers = diagnosis.evidence.model.numbers if diagnosis.evidence else ()
    both_ways = any(n.low < 0.0 < n.high for n in numbers if n.name == number.name)
    is_small = number.high - number.low > 2.0 * NEAR_0 * abs(number.value)
    return diagnosis.start_value(number.name) == 0.0 or (both_ways and is_small)


MUCH = 0.2
"""A number of the start model that is off by a larger share stands in every verdict."""


def describe_moved(diagnosis: Diagnosis) -> str:
    """Say which stated numbers of the start model are far off; empty where none is.

    Where much is left they stand in for what is missing, and nothing is said of them.
    """
    if describe_left(diagnosis):
        return ""
    stated = [n for n in diagnosis.recalibrated if n.name not in diagnosis.nominal.guessed]
    shifts = [(abs(relative_shift(diagnosis, n) or 0.0), n) for n in stated]
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
    said = [f"{name} {100.0 * shift:+.1f} %" for shift, name in moved]
    said += [
        f"{n.name} {diagnosis.start_value(n.name):.3g} to {n.value:.3g} {n.unit}".rstrip()
        for n in diagnosis.recalibrated
        if _is_near_0(diagnosis, n) and _is_off(diagnosis, n)
    ]
    return ", ".join(said) or f"no number by more than {100.0 * LEAST_SHIFT:.1f} %"


def describe_data(diagnosis: Diagnosis) -> list[str]:
    """Say which channels have faults, a line each, and whether the force moves the axis at all."""
    faults = [fault.says for about in diagnosis.noise.values() for fault in about.faults]
    evidence = diagnosis.evidence
    return [*faults, *[IMPOSED] * bool(evidence and evidence.weigher.train.imposed)]
