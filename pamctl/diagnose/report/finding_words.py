"""A finding in words: effects by name, laws without a name as a sentence has them, places, kinds.

The words follow the level that a finding reaches. Nothing here says more than the ladder does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pamctl.base.texts import count_of
from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.evidence.ladder import Finding, JudgedRival
from pamctl.diagnose.evidence.measuring_chain import list_of_chain
from pamctl.diagnose.evidence.pool import CHAIN, PAPER_SCALES, Hypothesis
from pamctl.diagnose.evidence.pool import list_terms as list_terms_of
from pamctl.diagnose.plant_numbers import UNITS, FittedNumber, unit_of
from pamctl.diagnose.report.setup_faults import (
    CALLED,
    SETUP_UNITS,
    SetupFault,
    label_fault,
    name_fault,
    say_fault,
)
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.description import Actuator
from pamctl.plant.model import PlantSettings, values_of
from pamctl.plant.terms import (
    DRIVER_UNITS,
    DRIVERS,
    KNOTS,
    LOCATIONS,
    OPERATORS,
    REFERENCES,
    SUFFIX,
    Location,
)

PLACES: Mapping[str, str] = {
    "valve": "the valve",
    "supply": "the supply",
    "air": "the air behind the valve",
    "friction": "the friction",
    "pull": "the forces that pull and push",
    "pressure_sensor": "the pressure sensor",
    "encoder": "the position sensor",
    "force_n": "the force sensor",
    "clock": "the times of the file",
    "scale": "the scales of the columns",
}
KINDS: Mapping[str, str] = {
    "lag": "something late or slow",
    "memory": "a memory at reversals",
    "wave": "a wave",
    "constant": "a constant change",
    "onset": "a change that begins at an instant",
    "turned": "a wrong sign",
    "clock": "a clock of another rate",
    "crosstalk": "a part of the command",
    "scale": "a factor",
}
_COLUMNS = {"encoder": "position_m", "pressure_sensor": "pressure_pa", "command": "valve_v"}
_SIGNALS = {"command": "the command", "position": "the position", "pressure": "the pressure",
            "velocity": "the velocity", "time": "time"}  # fmt: skip
_SHOWN: Mapping[str, tuple[float, str]] = {
    "m": (1e3, "mm"), "Pa": (1e-3, "kPa"), "V": (1.0, "V"), "m/s": (1e3, "mm/s"), "s": (1.0, "s"),
    "N": (1.0, "N"), "1": (100.0, "%"), "kg/s": (1e6, "mg/s"), "m3": (1e6, "cm3"),
}  # fmt: skip
_LAWS: Mapping[str, tuple[str, str]] = {
    "constant": ("is always there", "1"),
    "gain": ("grows in proportion to {signal}", "{q} / Q"),
    "curve": ("follows {signal} along a curve", "h({q})"),
    "beyond": ("begins beyond {width} of {signal} and grows from there", "max({q} - w, 0) / Q"),
    "wave": ("repeats itself every {width} of {signal}", "sin(2 pi {q} / w + phase)"),
    "onset": ("begins {width} after the start", "[{q} > w]"),
    "dead_zone": ("takes away what is within {width} of zero", "-clip({q}, -w, w) / Q"),
    "saturation": ("ends at {width}", "(clip({q}, -w, w) - {q}) / Q"),
    "lag": ("remembers {signal} for {width}", "(z - {q}) / Q,  w z' = {q} - z"),
    "play": ("follows with a play of {width}", "(z - {q}) / Q,  |z - {q}| <= w / 2"),
    "slew": ("follows no faster than {rate}", "(z - {q}) / Q,  |z'| <= w"),
    "hysteresis": (
        "remembers the last reversal of {signal} over {width}",
        "z,  dz = (sign(d{q}) - z) |d{q}| / w",
    ),
}
"""What a law does, in words and as an equation, by operator; w is its width, Q a reference."""
NEARLY_GONE, TURNED_OVER = -0.95, -1.05
"""Of a share that a law changes: below the first nearly nothing is left, below the other its sign
is another."""
MOST_IN_SENTENCE = 3
"""Members of a set in a sentence; the document has all."""
_BOTH_WAYS = ("wave", "hysteresis")


def spell_names(*names: str) -> str:
    """Return names of effects as a text has them: `valve_leak` is a valve leak.

    A law without a name, such as `force~lag(position)`, is a lag of force over position.
    """
    spelled = []
    for name in (part for joined in names for part in joined.split(" and ")):
        is_label = " of " in name
        named = label_term(name) if "~" in name else name_fault(name)
        is_key = is_label or name in UNITS
        spelled.append(named if is_key else named.replace("_", " ").replace(":", " of "))
    return " and ".join(spelled)


def label_term(name: str) -> str:
    """Name a law without a name in a list: `curve of force over time`.

    A law of a sensor or of the command is called after its column.
    """
    location, _, rest = name.partition("~")
    operator, _, driver = rest.rstrip(")").partition("(")
    return f"{operator} of {_COLUMNS.get(location, location)} over {driver}"


def call_hypotheses(actuator: Actuator) -> dict[str, list[str]]:
    """Return the names of hypotheses by the words that call them.

    An effect by its name, a law and a fault also by its label, all laws of a location by its name.
    """
    reach = dict.fromkeys(DRIVERS, (0.0, 1.0))
    laws = [*list_terms_of(actuator, reach, PAPER_SCALES)]
    plant = {**values_of(PlantSettings()), "stroke_m": 1.0}
    chain = list_of_chain([*CALLED], plant, 1e-3, actuator, reach)
    called = {name: [name] for name in CATALOGUE}
    for h in (*laws, *chain):
        for word in (h.name, label_hypothesis(h)):
            called.setdefault(word, [h.name])
    for h in laws:
        called.setdefault(h.name.partition("~")[0], []).append(h.name)
    return called


def label_hypothesis(hypothesis: Hypothesis) -> str:
    """Name a hypothesis in a list: an effect, a fault of the set-up, or a law without a name."""
    if hypothesis.setup:
        return label_fault(*hypothesis.setup)
    return label_term(hypothesis.name) if hypothesis.is_term else hypothesis.name


def spell_kind(kind: str) -> str:
    """Return a kind of law as a noun."""
    if kind.startswith("over "):
        signal = _SIGNALS[kind.removeprefix("over ")]
        return "a change over time" if signal == "time" else f"a law of {signal}"
    return KINDS.get(kind, f"a law like {spell_names(kind)}")


def spell_place(place: str) -> str:
    """Return a place as a noun."""
    return PLACES.get(place, spell_names(place))


def list_candidates(finding: Finding) -> list[str]:
    """Return the labels of what may be there, the best first."""
    members = (finding.hypothesis, *finding.rivals)
    return list(dict.fromkeys(label_hypothesis(h) for h in members))


def spell_set(labels: Sequence[str], first: str = "") -> str:
    """Return `a, b or c`; of a long set the first ones. `first` is spelled already."""
    names = [*map(spell_names, labels[:MOST_IN_SENTENCE])]
    names[:1] = [first or names[0]] if names else []
    if len(labels) > MOST_IN_SENTENCE:
        names.append("others")
    return " or ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def describe_standing(rival: JudgedRival) -> str:
    """Say how far a rival is behind or ahead, and what it means if that does not tell."""
    nats = f"{abs(rival.behind_nats):.0f} nats {'behind' if rival.behind_nats >= 0.0 else 'ahead'}"
    if rival.idle_numbers:
        return f"{nats}, and beaten: {count_of(rival.idle_numbers, 'more number')} for no gain"
    if rival.is_beaten:
        return nats
    if rival.is_freer:
        return f"{nats}, a freer law of its place, which can always mimic it"
    return f"{nats}, which does not rule it out" if rival.behind_nats >= 0.0 else nats


def is_in_catalogue(finding: Finding) -> bool:
    """Tell whether the best hypothesis is an effect of the catalogue."""
    return not finding.hypothesis.is_term and finding.hypothesis.setup is None


def spell_finding(diagnosis: Diagnosis, finding: Finding) -> str:
    """Return a finding as a noun, as far up as it is sure."""
    hypothesis, best = finding.hypothesis, spell_best(finding)
    if finding.level == "set":
        return spell_set(list_candidates(finding), best)
    if finding.level in ("name", "rest", "unjudged"):
        return best
    if hypothesis.is_term and finding.level == "kind":
        return FreeTerm.read(diagnosis, finding).text
    where, members = spell_place(hypothesis.place), spell_set(list_candidates(finding), best)
    if finding.level == "kind" and hypothesis.kind == hypothesis.family:  # a kind of its own
        return f"a law like {members} in {where}"
    what = spell_kind(hypothesis.kind) if finding.level == "kind" else "something"
    return f"{what} in {where} ({members})"


def spell_best(finding: Finding) -> str:
    """Return what fits best as a noun; a time of a column in it: `position_m late by 4.4 ms`."""
    kind, column = finding.hypothesis.setup or ("", "")
    if finding.numbers and kind in ("skew", "filtered"):
        value = finding.numbers[0].value
        what = "smoothed over" if kind == "filtered" else f"{'late' if value > 0 else 'early'} by"
        return f"{column} {what} {1e3 * abs(value):.3g} ms"
    return spell_names(label_hypothesis(finding.hypothesis))


# --- numbers -------------------------------------------------------------------------------------


def list_numbers(finding: Finding) -> list[FittedNumber]:
    """Return the fitted numbers of a finding, with units; a wave's as amplitude and phase."""
    by_name = {n.name: n for n in finding.numbers}
    found = []
    for n in finding.numbers:
        if n.name.endswith(".sine"):
            found += _join_wave(n, by_name[n.name.replace(".sine", ".cosine")])
        elif not n.name.endswith(".cosine"):
            found.append(_with_unit(n))
    return found


def list_fitted(diagnosis: Diagnosis) -> list[FittedNumber]:
    """Return every fitted number with its unit: of the model first, then of what was found."""
    found = (n for finding in diagnosis.findings for n in list_numbers(finding))
    return [*diagnosis.recalibrated, *found]


def _join_wave(sine: FittedNumber, cosine: FittedNumber) -> list[FittedNumber]:
    """Return amplitude and phase with their intervals, by propagation of errors."""
    family = sine.name.removeprefix(CHAIN).removesuffix(".sine")
    names = ("size", "phase") if family.endswith(SUFFIX) else ("amplitude_pa", "phase_rad")
    s, c = sine.value, cosine.value
    widths = np.array([0.5 * (n.high - n.low) for n in (sine, cosine)])
    size, phase = float(np.hypot(s, c)), float(np.arctan2(c, s))
    off = float(np.hypot(s * widths[0], c * widths[1])) / max(size, 1e-300)
    turn = float(np.hypot(c * widths[0], s * widths[1])) / max(size, 1e-300) ** 2
    return [
        FittedNumber(f"{family}.{n}", v, v - w, v + w, unit_of(f"{family}.{n}"))
        for n, v, w in zip(names, (size, phase), (off, turn), strict=True)
    ]


def _with_unit(n: FittedNumber) -> FittedNumber:
    if not n.name.startswith(CHAIN):
        return n
    kind, _, column = n.name.removeprefix(CHAIN).partition(".")
    units = {"zero": {"pressure_pa": "Pa", "position_m": "m", "force_n": "N"}.get(column, "")}
    return FittedNumber(n.name, n.value, n.low, n.high, {**SETUP_UNITS, **units}.get(kind, ""))


def find_form(diagnosis: Diagnosis, finding: Finding) -> str:
    """Return the form of an effect that was picked; its own name where it has but one."""
    assert diagnosis.evidence is not None
    variant = diagnosis.evidence.model.picked[finding.name]
    family = finding.hypothesis.family
    sizes = {u.name for u in variant.sizes}
    for form in CATALOGUE[family].forms:
        free = {f"{family}.{name}" for name in form.free}
        if sizes <= free and all(
            variant.held.get(f"{family}.{k}", v) == v for k, v in form.held.items()
        ):
            return form.name
    return family


# --- laws without a name -------------------------------------------------------------------------


@dataclass(frozen=True)
class FreeTerm:
    """A law without a name: where it acts, how, on what, with its fitted numbers."""

    location: Location
    operator: str
    driver: str
    values: Mapping[str, float]
    """Its numbers by short name; a wave's as the plant has them."""
    numbers: tuple[FittedNumber, ...]
    span: tuple[float, float]
    """Of a curve: where it begins and ends."""
    actuator: str = "muscle"

    @classmethod
    def read(cls, diagnosis: Diagnosis, finding: Finding) -> FreeTerm:
        """Return the term that a finding is."""
        assert diagnosis.evidence is not None
        prefix = f"{finding.hypothesis.family}."
        numbers = tuple(list_numbers(finding))
        all_values = {**diagnosis.evidence.values, **{n.name: n.value for n in numbers}}
        values = {k.removeprefix(prefix): v for k, v in all_values.items() if k.startswith(prefix)}
        return cls(
            LOCATIONS[finding.hypothesis.family.removesuffix(SUFFIX)],
            OPERATORS[round(values["operator"])], DRIVERS[round(values["driver"])],
            values, numbers, (values.get("low", 0.0), values.get("high", 1.0)),
            diagnosis.nominal.actuator,
        )  # fmt: skip

    @property
    def curve(self) -> list[dict[str, Any]]:
        """The knots of a curve, in SI; empty of another operator."""
        if self.operator != "curve":
            return []
        at = np.linspace(*self.span, KNOTS)
        size = self.values["size"]
        return [
            {"at": float(q), "value": size * n.value, "ci90": [size * n.low, size * n.high]}
            for q, n in zip(at, self.numbers, strict=True)
        ]

    @property
    def text(self) -> str:
        """The term as a noun: `a force that remembers the last reversal ..., +-1.5 N`."""
        place = self.location.words
        if self.actuator in ("chamber", "cylinder"):
            place = place.replace("muscle", self.actuator)
        article = place if place.startswith("a ") else f"a change of {place}"
        return f"{article} {self._describe_memory()}, {self._describe_size()}"

    def _describe_memory(self) -> str:
        signal, unit = _SIGNALS[self.driver], DRIVER_UNITS[self.driver]
        inner = self.values.get("inner", 1.0)
        width = spell_quantity(inner, "s" if self.operator == "lag" else unit)
        if self.operator == "wave" and self.driver == "time":
            return f"that swings every {width}"
        words, _ = _LAWS[self.operator]
        return f"that {words.format(signal=signal, width=width, rate=f'{inner:.3g} {unit}/s')}"

    def _describe_size(self) -> str:
        unit, size = self.location.unit, self.values["size"]
        sizes = [n for n in self.numbers if n.name.partition(".")[2].startswith(("size", "knot"))]
        if sizes and all(n.low < 0.0 < n.high for n in sizes):
            return "of a size that these data do not tell"
        if self.operator == "curve":
            low, high = (f([p["value"] for p in self.curve]) for f in (min, max))
            if unit == "1" and low < NEARLY_GONE:
                return _describe_loss(low, high)
            return f"from {spell_quantity(low, unit)} to {spell_quantity(high, unit)}"
        if self.operator in _BOTH_WAYS:
            return f"+-{spell_quantity(abs(size), unit)}"
        if self.operator in ("constant", "onset"):
            return spell_quantity(size, unit)
        per = spell_quantity(REFERENCES[self.driver], DRIVER_UNITS[self.driver])
        return f"{spell_quantity(size, unit)} for each {per}"

    @property
    def equation(self) -> str:
        """Its equation, in the symbols of its numbers."""
        symbols = {"command": "u", "position": "x", "pressure": "P_g", "velocity": "v", "time": "t"}
        law = _LAWS[self.operator][1].format(q=symbols[self.driver])
        place = self.location.name.replace("_", " ")
        return f"{place} (1 + size {law})" if self.location.unit == "1" else f"{place} + size {law}"

    @property
    def kin(self) -> list[str]:
        """Effects of the catalogue that act at the same place in the same way."""
        driver = "" if self.operator == "constant" else self.driver
        key = (self.location.name, self.operator, driver)
        return [
            effect.name
            for effect in CATALOGUE.values()
            if key in {(t.location, t.operator, t.driver) for t in effect.as_terms}
        ]

    def as_dict(self, others: list[str]) -> dict[str, Any]:
        """Return what the document holds; `others` are what the data do not tell it from."""
        return {
            "text": self.text,
            "location": self.location.name,
            "operator": self.operator,
            "driver": self.driver,
            "unit": self.location.unit,
            "driver_unit": DRIVER_UNITS[self.driver],
            "equation": self.equation,
            "parameters": {n.name.split(".")[1]: n.as_dict() for n in self.numbers},
            "curve": self.curve,
            "kin": self.kin,
            "cannot_be_told_from": others,
        }


def _describe_loss(low: float, high: float) -> str:
    """Say how far a curve takes something away, down to nothing or beyond."""
    if high < NEARLY_GONE:
        return "until nearly nothing of it is left"
    turned = ", where its sign turns" if low < TURNED_OVER else ""
    return f"from {spell_quantity(high, '1')} to the loss of all of it{turned}"


def spell_quantity(value: float, unit: str) -> str:
    """Return a value in the unit of a reader: `1.5 mm`."""
    factor, shown = _SHOWN.get(unit, (1.0, unit))
    return f"{factor * value:.3g} {shown}"


BEST_KNOWN = ("name", "set")
"""Levels at which the best hypothesis itself is shown: alone, or first of its set."""


def list_effects(diagnosis: Diagnosis) -> list[Finding]:
    """Return the findings that are effects of the catalogue, named or first of a set."""
    return [f for f in diagnosis.findings if f.level in BEST_KNOWN and is_in_catalogue(f)]


def list_faults(diagnosis: Diagnosis) -> list[SetupFault]:
    """Return the faults of the set-up that are named or first of a set, and lost commands."""
    found = [
        SetupFault.read(diagnosis, f, list_candidates(f)[1:] if f.level == "set" else [])
        for f in diagnosis.findings
        if f.level in BEST_KNOWN and f.hypothesis.setup
    ]
    held_s = diagnosis.evidence.held_s if diagnosis.evidence else 0.0
    if held_s:
        kind, number = "decimated_command", "valve_v"
        text, mend = say_fault(kind, number, held_s, "s", None)
        found.append(SetupFault(kind, number, held_s, (held_s, held_s), "s", None, [], mend, text))
    return found


def list_terms(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the laws without a name whose place and kind are sure, as the document has them."""
    return [
        FreeTerm.read(diagnosis, f).as_dict(list(map(label_hypothesis, f.rivals)))
        for f in diagnosis.findings
        if f.level == "kind" and f.hypothesis.is_term
    ]


def list_places(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return what is sure by its place only, or by place and kind where no free law is shown."""
    return [
        {
            "place": f.hypothesis.place,
            "kind": f.hypothesis.kind if f.level == "kind" else None,
            "text": spell_finding(diagnosis, f),
            "candidates": list_candidates(f),
        }
        for f in diagnosis.findings
        if f.level == "place" or (f.level == "kind" and not f.hypothesis.is_term)
    ]


def list_ambiguous(diagnosis: Diagnosis) -> list[list[str]]:
    """Return the sets of which one member is true, each with its best member first."""
    return [list_candidates(f) for f in diagnosis.findings if f.level == "set"]
