"""Phrases with numbers that terminal, document, plant file and page share.

A figure in a sentence is a figure of the document, in the unit of a reader.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from pamctl.diagnose.diagnosis import LEFT_TIMES, Diagnosis
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.evidence.pool import CHAIN
from pamctl.diagnose.plant_numbers import FittedNumber
from pamctl.diagnose.report.finding_words import list_numbers, spell_finding, spell_names

LEAST_SHIFT = 2e-3
"""A number that is off by a smaller share is not mentioned in a sentence."""
LARGE_GAP = 1e4
"""A gap of more of its units is shown in the unit of the signal: 20 mm, not 2e+04 µm."""


class SignalDisplay(NamedTuple):
    """How a signal is shown: users think in mm, µm and kPa."""

    title: str
    unit: str
    factor: float
    gap_unit: str
    gap_factor: float

    @property
    def short(self) -> str:
        """The title without its detail, in a sentence."""
        return self.title.split(",")[0].lower()

    def choose_unit(self, size: float) -> tuple[float, str]:
        """Return factor and unit for a gap of this size in SI: a large one is shown as a signal."""
        if size * self.gap_factor < LARGE_GAP:
            return self.gap_factor, self.gap_unit
        return self.factor, self.unit

    def spell_gap(self, size: float) -> str:
        """Return a gap with its unit."""
        factor, unit = self.choose_unit(size)
        return f"{spell_figure(factor * size)} {unit}"


def spell_figure(value: float) -> str:
    """Return a figure with three digits, and a large one without a power of ten."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


SIGNAL_DISPLAYS: Mapping[str, SignalDisplay] = {
    "position_m": SignalDisplay("Displacement", "mm", 1e3, "µm", 1e6),
    "pressure_pa": SignalDisplay("Pressure, absolute", "kPa", 1e-3, "kPa", 1e-3),
    "force_n": SignalDisplay("Force", "N", 1.0, "N", 1.0),
}


def join_words(parts: list[str]) -> str:
    """Return `a, b and c`."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def format_interval(low: float, high: float) -> str:
    """Return both ends with four digits, or with as many more as show that they differ."""
    for digits in range(4, 10):
        ends = [f"{end:.{digits}g}" for end in (low, high)]
        if ends[0] != ends[1]:
            return " to ".join(ends)
    return f"{low:.4g} to {high:.4g}"


def spell_number(number: FittedNumber) -> str:
    """Return a fitted number in one line: `fill_width_v 0.25 V (90 %: 0.249 to 0.251)`."""
    name = number.name.removeprefix(CHAIN).split(".")[-1]
    size = f"{number.value:.4g} {number.unit}".rstrip()
    return f"{name} {size} (90 %: {format_interval(number.low, number.high)})"


def list_said(diagnosis: Diagnosis) -> list[Finding]:
    """Return the findings that are said; what only mends the model is not."""
    return [f for f in diagnosis.findings if f.level != "rest"]


def spell_findings(diagnosis: Diagnosis, *levels: str) -> str:
    """Return the findings of these levels as a list of nouns."""
    return join_words(
        [
            spell_finding(diagnosis, f)
            for f in list_said(diagnosis)
            if f.level in levels and (f.level != "name" or f.hypothesis.setup is None)
        ]
        or [""]
    )


def describe_sizes(diagnosis: Diagnosis) -> str:
    """Return the numbers of the named effects; empty where none is named."""
    parts = [
        f"{spell_names(f.hypothesis.family)}: {', '.join(map(spell_number, list_numbers(f)))}"
        for f in list_said(diagnosis)
        if f.level == "name" and f.hypothesis.setup is None
    ]
    return f"{'; '.join(parts)}." if parts else ""


def describe_bounds(diagnosis: Diagnosis) -> str:
    """Name the fitted numbers that ended at an end of their range; empty where none did."""
    ended = [name.removeprefix(CHAIN) for name in diagnosis.at_bound]
    if not ended:
        return ""
    return f", with {join_words(ended)} at an end of {'its range' if len(ended) == 1 else 'ranges'}"


def describe_gap(diagnosis: Diagnosis) -> str:
    """Say what each model leaves of each channel, in plain units, and whether that is noise."""
    parts = []
    for channel, gap in diagnosis.gap.items():
        display = SIGNAL_DISPLAYS[channel]
        start, recalibrated, extended = map(display.spell_gap, gap[:3])
        steps = [f"{start} by the start model", f"{recalibrated} recalibrated"]
        if diagnosis.findings:
            steps.append(f"{extended} with what was found")
        noise = display.spell_gap(gap.floor)
        parts.append(f"{display.short} {', '.join(steps)} (noise of its sensor {noise})")
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


def describe_noise(diagnosis: Diagnosis) -> list[str]:
    """Say which channels have faults or unknown noise, a line each."""
    return [line for c, about in diagnosis.noise.items() for line in about.list_faults(c)]
