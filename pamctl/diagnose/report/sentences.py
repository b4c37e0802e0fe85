"""The verdict in plain words, for the terminal and the head of the report."""

from __future__ import annotations

from collections.abc import Iterator

from pamctl.diagnose.correction import CorrectionResult
from pamctl.diagnose.diagnosis import Diagnosis, find_largest_remainder
from pamctl.diagnose.experiments import write_command
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.integrator import describe_integrator
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.next_experiment import choose_next_experiment
from pamctl.plant.catalogue import CATALOGUE


def sentence(diagnosis: Diagnosis) -> str:
    """Say what was found, in one or two sentences."""
    block, ratio, regimes = find_largest_remainder(diagnosis)
    names = " and ".join(_describe_effect(diagnosis, s.effect.name) for s in diagnosis.standings)
    match diagnosis.verdict:
        case Verdict.BAD_DATA:
            return f"These data cannot be diagnosed: {diagnosis.reason}"
        case Verdict.NO_DISCREPANCY:
            return "The model explains the measurement down to the noise; nothing is missing."
        case Verdict.MISCALIBRATED:
            shifts = _list_shifts(diagnosis)
            return f"Nothing is missing from the model, but numbers are off: {shifts}."
        case Verdict.NAMED:
            return f"Missing from the model: {names}. With it the rest is at the noise floor."
        case Verdict.AMBIGUOUS:
            sets = " or ".join(
                ", ".join([s.effect.name, *s.equal_rivals])
                for s in diagnosis.standings
                if s.equal_rivals
            )
            return (
                f"Something is missing that these data do not tell apart: one of {sets}. "
                f"Best so far: {names}."
            )
        case Verdict.PARTIAL:
            return (
                f"{names} closes {100.0 * diagnosis.explained:.0f} % of the gap but does not "
                f"explain the measurement: {block} is left at {ratio:.1f} x its floor ({regimes})."
            )
        case Verdict.NONE_KNOWN:
            return (
                f"No known effect explains the measurement: {block} is left at {ratio:.1f} x its "
                f"floor ({regimes})."
            )


def summary(diagnosis: Diagnosis) -> str:
    """Lay the diagnosis out for a terminal: the sentence, then what it rests on."""
    parts = [f"{diagnosis.verdict.value}: {sentence(diagnosis)}"]
    if diagnosis.numbers:
        parts.append("\n".join(_number_rows(diagnosis)))
    if diagnosis.standings:
        parts.append("\n".join(_rival_rows(diagnosis)))
    if diagnosis.gap:
        parts.append("\n".join(_gap_rows(diagnosis)))
    if diagnosis.model and any(
        floor.decided_by == "repeatability" for floor in diagnosis.model.floors.values()
    ):
        parts.append(describe_discrepancy_limits(diagnosis.model))
    if describe_integrator(diagnosis.stepping):
        parts.append(describe_integrator(diagnosis.stepping))
    if diagnosis.remainder is not None:
        parts.append(diagnosis.remainder.sentence)
    if diagnosis.corrected is not None:
        parts.append(describe_correction_result(diagnosis.corrected))
    following = choose_next_experiment(diagnosis)
    if following:
        parts.append(f"next: {write_command(following['name'])}: {following['why']}")
    return "\n\n".join(parts)


def _number_rows(diagnosis: Diagnosis) -> Iterator[str]:
    yield f"{'fitted':<36}{'value':>12}  90 % interval"
    for n in diagnosis.numbers:
        yield f"{n.name:<36}{n.value:>12.5g}  {n.low:.5g} to {n.high:.5g} {n.unit}".rstrip()


def _rival_rows(diagnosis: Diagnosis) -> Iterator[str]:
    yield f"{'effect':<24}{'rival':<24}{'left, x floor':>14}"
    for standing in diagnosis.standings:
        for rival in standing.rivals[:3]:
            equal = "  no worse: these data do not tell" if rival.is_equal else ""
            left = f"{rival.residual_over_floor:>14.2f}{equal}"
            yield f"{standing.effect.name:<24}{rival.name:<24}{left}"


def describe_discrepancy_limits(model: Model) -> str:
    """Say what a discrepancy was held against."""
    told = []
    for block, floor in model.floors.items():
        repeats = floor.decided_by == "repeatability"
        by = "the rig does not repeat itself any better" if repeats else "by self-simulation"
        told.append(f"{block} {floor.limit / floor.mean:.2f} times the floor ({by})")
    known = any(floor.repeatability for floor in model.floors.values())
    without = (
        ""
        if known
        else " No record repeats another's commands or reference, so the rig's own repeatability "
        "is not known: run the same experiment twice to have it counted."
    )
    return f"Above these limits a misfit is a discrepancy: {', '.join(told)}.{without}"


def describe_correction_result(added: CorrectionResult) -> str:
    """Say whether the unnamed correction is in the model, and what it does to the gap."""
    rows = []
    for name, before in added.before.items():
        factor, label = gap_units(name)
        rows.append(f"{label} from {factor * before:.4g} to {factor * added.after[name]:.4g}")
    gap = f" Held-out gap, RMS: {'; '.join(rows)}." if added.blocks else ""
    state = "added to the model" if added.blocks else "left out of the model"
    return f"Unnamed correction {state}: {added.why}.{gap}"


def _gap_rows(diagnosis: Diagnosis) -> Iterator[str]:
    head = (
        f"{'held-out gap, RMS':<20}{'nominal':>12}{'recalibrated':>14}{'extended':>12}{'floor':>10}"
    )
    yield head
    for name, gap in (diagnosis.gap or {}).items():
        factor, label = gap_units(name)
        row = [gap.nominal, gap.recalibrated, gap.extended, gap.floor]
        a, b, c, d = (f"{factor * value:.4g}" for value in row)
        yield f"{label:<20}{a:>12}{b:>14}{c:>12}{d:>10}"


def gap_units(channel: str) -> tuple[float, str]:
    """Return the factor from SI to what a reader wants, and what to call it."""
    return (1e6, "position, um") if channel == "position_m" else (1e-3, "pressure, kPa")


def _describe_effect(diagnosis: Diagnosis, name: str) -> str:
    numbers = [n for n in diagnosis.numbers if n.name.startswith(f"{name}.")]
    listed = ", ".join(f"{n.name.split('.')[1]} {_format_value(n)}" for n in numbers)
    return f"{name} ({listed}; {CATALOGUE[name].equation})"


def _format_value(number: FittedNumber) -> str:
    half = 0.5 * (number.high - number.low)
    return f"{number.value:.4g} +- {half:.2g} {number.unit}".rstrip()


def _list_shifts(diagnosis: Diagnosis) -> str:
    rows = []
    for number in diagnosis.recalibrated:
        nominal = diagnosis.start_value(number.name)
        change = number.value / nominal - 1.0 if nominal else 0.0
        outside = not number.low <= nominal <= number.high
        if outside and abs(change) > 2e-3:
            rows.append((abs(change), f"{number.name} {100.0 * change:+.1f} %"))
    return ", ".join(text for _, text in sorted(rows, reverse=True)) or "slightly"
