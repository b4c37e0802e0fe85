"""Phrases that terminal, document, plant file and page share."""

from __future__ import annotations

from collections.abc import Mapping

from pamctl.diagnose.diagnosis import Diagnosis, find_largest_remainder
from pamctl.diagnose.extend import CorrectionResult
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import doubt_floor
from pamctl.diagnose.fitting.integrator import SMALL
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.locate import EVENLY
from pamctl.diagnose.naming.remainder import Remainder
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.description import EffectParameter

LEAST_SHIFT = 2e-3
"""A number that is off by a smaller share is not mentioned in a sentence."""


def spell_names(*names: str) -> str:
    """Return names of effects as a text has them: `valve_leak` is a valve leak."""
    return " and ".join(name.replace("_", " ") for name in names)


def spell_effects(diagnosis: Diagnosis) -> str:
    """Return the named effects as a text has them."""
    return spell_names(*(standing.effect.name for standing in diagnosis.standings))


def parameter_of(name: str) -> EffectParameter:
    """Return the catalogue's description of a number such as `valve_leak.area_m2`."""
    effect, number = name.split(".")
    return next(p for p in CATALOGUE[effect].parameters if p.name == number)


def numbers_of(diagnosis: Diagnosis, effect: str) -> list[FittedNumber]:
    """Return the fitted numbers of an effect."""
    return [number for number in diagnosis.numbers if number.name.startswith(f"{effect}.")]


def describe_effects(diagnosis: Diagnosis) -> str:
    """Return the named effects as plant files call them, each with its numbers and equation."""
    parts = []
    for standing in diagnosis.standings:
        name = standing.effect.name
        numbers = ", ".join(map(_format_number, numbers_of(diagnosis, name)))
        parts.append(f"{name} ({numbers}; {CATALOGUE[name].equation})")
    return " and ".join(parts)


def _format_number(number: FittedNumber) -> str:
    name = number.name.split(".")[1]
    half = 0.5 * (number.high - number.low)
    return f"{name} {number.value:.4g} +- {half:.2g} {number.unit}".rstrip()


def list_sizes(diagnosis: Diagnosis) -> str:
    """Return the numbers of the named effects by their meaning, with 90 % intervals."""
    return ", ".join(
        f"{parameter_of(n.name).meaning}: {n.value:.4g} {n.unit}".rstrip()
        + f" (90 %: {n.low:.4g} to {n.high:.4g})"
        for standing in diagnosis.standings
        for n in numbers_of(diagnosis, standing.effect.name)
    )


def list_sets(diagnosis: Diagnosis) -> str:
    """Return the sets of effects that the data do not tell apart."""
    return "; and ".join(
        " or ".join(spell_names(name) for name in (s.effect.name, *s.equal_rivals))
        for s in diagnosis.standings
        if s.equal_rivals
    )


def relative_shift(diagnosis: Diagnosis, number: FittedNumber) -> float | None:
    """Return by which share a recalibrated number is off; None where its interval allows 0."""
    nominal = diagnosis.start_value(number.name)
    if number.low <= nominal <= number.high or nominal == 0.0:
        return None
    return number.value / nominal - 1.0


def list_shifts(diagnosis: Diagnosis) -> str:
    """Return the numbers of the start model that are off, the largest change first."""
    shifts = [(relative_shift(diagnosis, n) or 0.0, n.name) for n in diagnosis.recalibrated]
    moved = sorted((s for s in shifts if abs(s[0]) > LEAST_SHIFT), key=lambda s: -abs(s[0]))
    listed = ", ".join(f"{name} {100.0 * shift:+.1f} %" for shift, name in moved)
    return listed or f"no number by more than {100.0 * LEAST_SHIFT:.1f} %"


def describe_largest_remainder(diagnosis: Diagnosis) -> str:
    """Say which block has the most left, how much, and in which regimes."""
    block, ratio, regimes = find_largest_remainder(diagnosis)
    where = f", {regimes}" if regimes == EVENLY else f"; worst: {regimes}"
    return f"The {block} block is left at {ratio:.1f} times its floor{where}."


LIMIT_WORDS = {
    "repeatability": "the rig does not repeat itself any better",
    "quiet stretches": "an estimate from the quietest stretches, since the noise is unknown",
    "self-simulation": "by self-simulation",
}


def describe_noise(diagnosis: Diagnosis) -> str:
    """Say which channels have faults or unknown noise, and which floors cannot be right."""
    lines = [
        line for channel, about in diagnosis.noise.items() for line in about.list_faults(channel)
    ]
    if diagnosis.model is not None:
        model = diagnosis.model
        lines += [d for b in model.evidence.blocks if (d := doubt_floor(b, model.ratio(b)))]
    return "\n".join(lines)


def describe_limits(model: Model) -> str:
    """Say above which limits a misfit counts as a discrepancy."""
    limits = []
    for block, floor in model.floors.items():
        by = LIMIT_WORDS[floor.decided_by]
        limits.append(f"{block} {floor.limit / floor.mean:.2f} times the floor ({by})")
    text = f"A misfit above these limits is a discrepancy: {', '.join(limits)}."
    if any(floor.repeatability for floor in model.floors.values()):
        return text
    return (
        f"{text} No record repeats another's commands or reference, so the rig's own repeatability "
        "is not known. To include it, run the same experiment twice."
    )


def describe_remainder(remainder: Remainder) -> str:
    """Say what shape the residual has, and that this is no cause."""
    if not remainder.terms:
        return f"Unnamed correction of the {remainder.block}: no simple shape fits what is left."
    terms = " ".join(f"{value:+.3g} {term}" for term, value in remainder.terms)
    return (
        f"Unnamed correction, not a cause: the remainder of the {remainder.block} looks like "
        f"{terms} {remainder.unit}. This covers {100.0 * remainder.explained:.0f} % of its square; "
        "each signal is scaled to its largest magnitude."
    )


def describe_correction(correction: CorrectionResult) -> str:
    """Say whether the unnamed correction is in the model, and what it does to the gap."""
    rows = []
    for channel, before in correction.before.items():
        factor, label = gap_units(channel)
        after = correction.after[channel]
        rows.append(f"{label} from {factor * before:.4g} to {factor * after:.4g}")
    gap = f" Held-out gap, RMS: {'; '.join(rows)}." if correction.blocks else ""
    state = "added to the model" if correction.blocks else "left out of the model"
    return f"Unnamed correction {state}: {correction.why}.{gap}"


def describe_substeps(changes: Mapping[str, float]) -> str:
    """Say which blocks half the integrator's sub-step changes; empty where no change matters."""
    large = [
        f"{block} by {change:.2f} x floor" for block, change in changes.items() if change > SMALL
    ]
    if not large:
        return ""
    return (
        f"Half the integrator's sub-step changes {' and '.join(large)}. That much of the fit comes "
        "from the simulation, not from the rig. The intervals include it. The numbers are those "
        "with which this simulation fits best."
    )


def gap_units(channel: str) -> tuple[float, str]:
    """Return the factor from SI to the unit of a terminal, and the label with that unit."""
    return (1e6, "position, um") if channel == "position_m" else (1e-3, "pressure, kPa")
