"""Phrases that terminal, document, plant file and page share."""

from __future__ import annotations

from collections.abc import Mapping

from pamctl.diagnose.diagnosis import Diagnosis, find_largest_remainder
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import doubt_floor
from pamctl.diagnose.fitting.integrator import SMALL
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.fitting.numbers import look_up_parameter
from pamctl.diagnose.locate import EVENLY
from pamctl.diagnose.naming.doubt import is_strained
from pamctl.diagnose.naming.remainder import Remainder
from pamctl.diagnose.naming.unseen import list_unseen
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.plant.catalogue import CATALOGUE

LEAST_SHIFT = 2e-3
"""A number that is off by a smaller share is not mentioned in a sentence."""


def spell_names(*names: str) -> str:
    """Return names of effects as a text has them: `valve_leak` is a valve leak."""
    return " and ".join(name.replace("_", " ") for name in names)


def spell_effects(diagnosis: Diagnosis) -> str:
    """Return the named effects as a text has them."""
    return spell_names(*(standing.effect.name for standing in diagnosis.standings))


def numbers_of(diagnosis: Diagnosis, effect: str) -> list[FittedNumber]:
    """Return the fitted numbers of an effect."""
    return [number for number in diagnosis.numbers if number.name.startswith(f"{effect}.")]


def mark_bound(diagnosis: Diagnosis, name: str) -> str:
    """Mark a fitted number that ended at an end of the range in which it was searched."""
    return "at an end" if name in diagnosis.at_bound else ""


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


def format_interval(low: float, high: float) -> str:
    """Return both ends with four digits, or with as many more as show that they differ."""
    for digits in range(4, 10):
        ends = [f"{end:.{digits}g}" for end in (low, high)]
        if ends[0] != ends[1]:
            return " to ".join(ends)
    return f"{low:.4g} to {high:.4g}"


def list_sizes(diagnosis: Diagnosis) -> str:
    """Return the numbers of the named effects by their meaning, with 90 % intervals."""
    return ", ".join(
        f"{look_up_parameter(n.name).meaning}: {n.value:.4g} {n.unit}".rstrip()
        + f" (90 %: {format_interval(n.low, n.high)})"
        for standing in diagnosis.standings
        for n in numbers_of(diagnosis, standing.effect.name)
    )


def list_sets(diagnosis: Diagnosis) -> str:
    """Return the sets of effects and set-up numbers that the data do not tell apart."""
    return "; and ".join(
        " or ".join(map(spell_names, names)) for names in list_equal_sets(diagnosis)
    )


def spell_settled_effects(diagnosis: Diagnosis) -> str:
    """Return the named effects that are in no set."""
    open_ones = {names[0] for names in list_equal_sets(diagnosis)}
    names = (s.effect.name for s in diagnosis.standings)
    return spell_names(*(name for name in names if name not in open_ones))


def describe_closed_shares(diagnosis: Diagnosis) -> str:
    """Say how much of what each block leaves the effects close."""
    parts = [
        f"{spell_share(share)} % of the {block} block's gap"
        for block, share in diagnosis.explained_by_block.items()
    ]
    return f"closes {' and '.join(parts)}" if parts else "makes the blocks agree"


def spell_share(share: float) -> str:
    """Return a share in per cent; 100 only where nothing is left."""
    percent = 100.0 * max(share, 0.0)
    return f"{percent:.0f}" if percent >= 100.0 or percent < 99.5 else f"{min(percent, 99.9):.1f}"


def describe_bounds(diagnosis: Diagnosis) -> str:
    """Name the fitted numbers that ended at an end of their range, and those not shown at all."""
    ended = ", ".join(diagnosis.at_bound)
    words = f" At an end of its range: {ended}." if ended else ""
    unseen = list_unseen(diagnosis.model) if diagnosis.model else ()
    if unseen:
        words += (
            f" These records do not show {' and '.join(unseen)}: the plant file's "
            f"{'number stays' if len(unseen) == 1 else 'numbers stay'}."
        )
    return words


def describe_signs(diagnosis: Diagnosis) -> str:
    """Say what in the residuals speaks against noise."""
    parts = [f"in the {sign.block} block {sign.words}" for sign in diagnosis.signs]
    return f"The residual is at its limit, but it does not look like noise: {'; '.join(parts)}."


def list_equal_sets(diagnosis: Diagnosis) -> list[list[str]]:
    """Return the sets of names that the data do not tell apart, of effects and of the set-up."""
    sets = []
    imitates = diagnosis.model is not None and is_strained(diagnosis.model)
    for s in diagnosis.standings:
        name = s.effect.name
        setup = [f.label for f in diagnosis.setup if name in f.cannot_be_told_from]
        if s.equal_rivals or ((setup or imitates) and diagnosis.verdict is Verdict.AMBIGUOUS):
            sets.append([name, *s.equal_rivals, *setup])
    return sets


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
    regimes = spell_regimes(diagnosis, regimes)
    where = f", {regimes}" if regimes == EVENLY else f"; worst: {regimes}"
    rms = _spell_rms(diagnosis, block, ratio)
    return f"The {block} block is left at {ratio:.1f} times its floor{rms}{where}."


def spell_regimes(diagnosis: Diagnosis, regimes: str) -> str:
    """Return regimes in the words of the rig: only a muscle contracts."""
    if diagnosis.nominal.actuator == "muscle":
        return regimes
    forward = regimes.replace("contracting", "moving to larger x")
    return forward.replace("lengthening", "moving to smaller x")


def _spell_rms(diagnosis: Diagnosis, block: str, ratio: float) -> str:
    """Return the RMS of a residual that is this multiple of the block's floor, in brackets."""
    model = diagnosis.model
    if model is None:
        return ""
    drive = model.evidence.holdout[block][0]
    factor, label = gap_units(drive.channel)
    rms = ratio * model.floors[block].mean * drive.deviation * factor
    unit = label.split(", ")[1]
    if unit == "um" and rms >= 1e4:
        return f" (RMS {rms / 1e3:.3g} mm)"
    return f" (RMS {rms:.3g} {unit})"


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


def describe_remainder(remainder: Remainder, actuator: str) -> str:
    """Say what shape the residual has, and that this is no cause."""
    if not remainder.terms:
        return f"Unnamed correction of the {remainder.block}: no simple shape fits what is left."
    terms = " ".join(f"{value:+.3g} {term}" for term, value in remainder.terms)
    if actuator == "direct":  # a force drives it, where a muscle has its pressure
        terms = terms.replace("P", "F")
    return (
        f"Unnamed correction, not a cause: the remainder of the {remainder.block} looks like "
        f"{terms} {remainder.unit}. This covers {100.0 * remainder.explained:.0f} % of its square; "
        "each signal is scaled to its largest magnitude."
    )


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
    return {
        "position_m": (1e6, "position, um"),
        "pressure_pa": (1e-3, "pressure, kPa"),
        "force_n": (1.0, "force, N"),
    }[channel]
