"""What the page says in plain words: its title, the verdict, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis, find_largest_remainder
from pamctl.diagnose.experiments import write_command
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.locate import EVENLY
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.next_experiment import choose_next_experiment
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.description import EffectParameter

_RECORD = "pamctl run --experiment diagnosis --set experiment.seed=3 --log next.mcap"


def spell_names(*names: str) -> str:
    """Return names of effects as a text has them: `valve_leak` is a valve leak."""
    return " and ".join(name.replace("_", " ") for name in names)


def write_headline(diagnosis: Diagnosis) -> str:
    """Return the verdict as a headline."""
    names = spell_names(*(s.effect.name for s in diagnosis.standings))
    match diagnosis.verdict:
        case Verdict.BAD_DATA:
            return "These data cannot be diagnosed"
        case Verdict.NO_DISCREPANCY:
            return "The model explains the measurement"
        case Verdict.MISCALIBRATED:
            return "Nothing is missing from the model, but its numbers are off"
        case Verdict.NAMED:
            return f"Missing from the model: {names}"
        case Verdict.AMBIGUOUS:
            return f"Something is missing, and these data do not tell what: {_list_sets(diagnosis)}"
        case Verdict.PARTIAL:
            return f"Explained in part only: {names}"
        case Verdict.NONE_KNOWN:
            return "Something is missing, and it is none of the known effects"


def explain_verdict(diagnosis: Diagnosis) -> str:
    """Say what was found to somebody who was not there, in a few sentences."""
    names = spell_names(*(s.effect.name for s in diagnosis.standings))
    match diagnosis.verdict:
        case Verdict.BAD_DATA:
            return f"Nothing was fitted and nothing is concluded. The reason: {diagnosis.reason}"
        case Verdict.NO_DISCREPANCY:
            return (
                "The model as it stands leaves no more than it would leave on data that it had "
                "made itself: sensor noise. Nothing is missing that these data could show."
            )
        case Verdict.MISCALIBRATED:
            return (
                "With other numbers the model leaves no more than sensor noise; it needs no "
                f"further effect. Off are: {_list_shifts(diagnosis)}."
            )
        case Verdict.NAMED:
            return (
                f"No other choice of its numbers lets the model explain the measurement. With "
                f"{names} it does, down to what the sensors add. "
                f"Its size: {_list_sizes(diagnosis)}."
            )
        case Verdict.AMBIGUOUS:
            return (
                f"No other choice of its numbers lets the model explain the measurement, but "
                f"more than one effect does: {_list_sets(diagnosis)}. The model written down has "
                f"{names}, which fits best ({_list_sizes(diagnosis)}). "
                "It predicts what was measured; "
                "the cause is open until the experiment below has been run."
            )
        case Verdict.PARTIAL:
            block, ratio, regimes = find_largest_remainder(diagnosis)
            return (
                f"{names[:1].upper()}{names[1:]} closes {100.0 * diagnosis.explained:.0f} % of the "
                f"gap ({_list_sizes(diagnosis)}), and something else is left: "
                f"the {block} block is at "
                f"{ratio:.1f} times its floor, {_describe_where(regimes)}. "
                "Take the name as a lead, not as "
                "a finding."
            )
        case Verdict.NONE_KNOWN:
            block, ratio, regimes = find_largest_remainder(diagnosis)
            return (
                "No effect of the catalogue, alone or with others, explains what is left when "
                f"the numbers are right: the {block} block is at {ratio:.1f} times its floor, "
                f"{_describe_where(regimes)}. It has a shape, drawn below, but no name."
            )


def advise_next_steps(diagnosis: Diagnosis) -> Iterator[str]:
    """Say what to do next, the first thing first."""
    experiment = choose_next_experiment(diagnosis)
    match diagnosis.verdict:
        case Verdict.BAD_DATA:
            yield "Mend what the reason names, and look at the log with `pamctl log check LOG`."
            yield f"Record anew, from the vented muscle at rest: `{_RECORD}`."
            return
        case Verdict.NO_DISCREPANCY:
            yield "Go on with the model that you have."
        case Verdict.MISCALIBRATED:
            yield "Go on with plant.yaml, the same model with these numbers."
        case Verdict.NAMED:
            yield (
                "Go on with plant.yaml, which has the effect: `pamctl tune --plant plant.yaml`, "
                "`pamctl run --plant plant.yaml`."
            )
        case Verdict.AMBIGUOUS:
            yield "Do not repair the rig on this evidence: run the experiment that separates them."
        case Verdict.PARTIAL:
            yield (
                "plant.yaml predicts better than before; use it where that is enough. A next "
                "diagnosis may start from it: `pamctl diagnose next.mcap --plant plant.yaml`."
            )
        case Verdict.NONE_KNOWN:
            yield (
                "Look where the maps below are bright, and at the rig: supply, tubing, mounting, "
                "sensors. plant.yaml has the better numbers, and no effect."
            )
            if diagnosis.corrected is not None and diagnosis.corrected.blocks:
                yield (
                    "It also has a table without a name, which predicts better and explains "
                    "nothing: a law may be tuned on it, the rig should not be judged by it."
                )
            elif diagnosis.corrected is None:
                yield (
                    "Where prediction matters more than the cause: `pamctl diagnose --correction` "
                    "adds what is left to the model, as a table without a name."
                )
    if experiment:
        yield _describe_experiment(experiment)
        yield f"The program that has all experiments: `{_RECORD}`."


def _describe_where(regimes: str) -> str:
    return regimes if regimes == EVENLY else f"most of all in {regimes}"


def _describe_experiment(experiment: Mapping[str, Any]) -> str:
    effects = experiment["separates"]
    apart = f", which tells {' from '.join(map(spell_names, effects))}" if len(effects) > 1 else ""
    return f"Next experiment: `{write_command(experiment['name'])}`{apart}: {experiment['why']}."


def parameter_of(name: str) -> EffectParameter:
    """Return what the catalogue says of `valve_leak.area_m2`."""
    effect, number = name.split(".")
    return next(p for p in CATALOGUE[effect].parameters if p.name == number)


def format_number_interval(number: FittedNumber) -> str:
    """Write a number with its 90 % interval."""
    low, high = f"{number.low:.4g}", f"{number.high:.4g}"
    return f"{number.value:.4g} {number.unit}".rstrip() + f" (90 %: {low} to {high})"


def relative_shift(diagnosis: Diagnosis, number: FittedNumber) -> float | None:
    """Return by which share a number of the muscle is off; None where its interval allows 0."""
    nominal = diagnosis.start_value(number.name)
    if number.low <= nominal <= number.high or nominal == 0.0:
        return None
    return number.value / nominal - 1.0


def _list_shifts(diagnosis: Diagnosis) -> str:
    shifts = [(relative_shift(diagnosis, n), n.name) for n in diagnosis.recalibrated]
    moved = sorted(((s, name) for s, name in shifts if s is not None), key=lambda p: -abs(p[0]))
    return ", ".join(f"{name} by {100.0 * s:+.2g} %" for s, name in moved) or "none by much"


def _list_sizes(diagnosis: Diagnosis) -> str:
    named = {s.effect.name for s in diagnosis.standings}
    return ", ".join(
        f"{parameter_of(n.name).meaning}: {format_number_interval(n)}"
        for n in diagnosis.numbers
        if n.name.split(".")[0] in named
    )


def _list_sets(diagnosis: Diagnosis) -> str:
    return "; and ".join(
        " or ".join(spell_names(name) for name in (s.effect.name, *s.equal_rivals))
        for s in diagnosis.standings
        if s.equal_rivals
    )
