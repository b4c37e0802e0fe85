"""A term in words: its place, its memory, its size, its kin; and as an equation."""

from __future__ import annotations

from collections.abc import Mapping

from pamctl.diagnose.terms.grammar import Question
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.description import AsTerm, EffectDescription
from pamctl.plant.terms.operators import DRIVER_UNITS, KNOTS, REFERENCES

_SHOWN: Mapping[str, tuple[float, str]] = {
    "m": (1e3, "mm"), "Pa": (1e-3, "kPa"), "V": (1.0, "V"), "m/s": (1e3, "mm/s"), "s": (1.0, "s"),
    "N": (1.0, "N"), "1": (100.0, "%"), "kg/s": (1e6, "mg/s"), "m3": (1e6, "cm3"),
    "N/m": (1.0, "N/m"), "N s/m": (1.0, "N s/m"), "V/s": (1.0, "V/s"),
}  # fmt: skip
_SIGNALS = {"command": "the command", "position": "the position", "pressure": "the pressure",
            "velocity": "the velocity", "time": "time"}  # fmt: skip


def find_kin(question: Question) -> tuple[str, ...]:
    """Return the names of effects that this term resembles; they were tried and did not fit."""
    return tuple(effect.name for effect, _ in list_kin(question))


def list_kin(question: Question) -> list[tuple[EffectDescription, AsTerm]]:
    """Return the effects of the catalogue that act at the same place in the same way."""
    driver = "" if question.operator == "constant" else question.driver
    key = (question.location.name, question.operator, driver)
    return [
        (effect, term)
        for effect in CATALOGUE.values()
        for term in effect.as_terms
        if (term.location, term.operator, term.driver) == key
    ]


def spell_quantity(value: float, unit: str) -> str:
    """Return a value in the unit of a reader: `1.5 mm`."""
    factor, shown = _SHOWN.get(unit, (1.0, unit))
    return f"{factor * value:.3g} {shown}"


def describe_memory(question: Question, inner: float | None) -> str:
    """Return how the driver acts, as a part of a sentence."""
    signal, unit = _SIGNALS[question.driver], DRIVER_UNITS[question.driver]
    operator = question.operator
    if operator == "constant":
        return "that is always there"
    if operator == "gain":
        return f"in proportion to {signal}"
    if operator == "curve":
        return f"that follows {signal} along a curve"
    width = "" if inner is None else spell_quantity(inner, unit)
    if operator == "wave" and question.driver == "time":
        return f"that swings at {1.0 / (inner or 1.0):.3g} Hz"
    return {
        "beyond": f"that begins beyond {width} of {signal} and grows from there",
        "wave": f"that repeats itself every {width} of {signal}",
        "onset": f"that begins {width} after the start",
        "dead_zone": f"that takes away what is within {width} of zero",
        "saturation": f"that ends at {width}",
        "lag": f"that remembers {signal} for {spell_quantity(inner or 0.0, 's')}",
        "play": f"that follows with a play of {width}",
        "slew": f"that follows no faster than {spell_quantity(inner or 0.0, 'V/s')}",
        "hysteresis": f"that remembers the last reversal of {signal} over {width}",
    }[operator]


def describe_size(question: Question, size: float) -> str:
    """Return the size, and what it is for."""
    location = question.location
    if question.is_following:
        return f"{100.0 * size:.0f} % of it"
    shown = spell_quantity(abs(size) if question.operator in _BOTH_WAYS else size, location.unit)
    if question.operator in _BOTH_WAYS:
        return f"+-{shown}"
    if question.operator in ("constant", "onset"):
        return shown
    per = spell_quantity(REFERENCES[question.driver], DRIVER_UNITS[question.driver])
    return f"{shown} for each {per}"


_BOTH_WAYS = ("wave", "hysteresis")


def describe_term(question: Question, values: Mapping[str, float]) -> str:
    """Return a term as a noun: `a force that remembers the last reversal ..., +-1.5 N`.

    `values` are its numbers by full name.
    """
    inner = values.get(question.prefix + "inner")
    place = question.location.words
    article = place if place.startswith("a ") else f"a change of {place}"
    memory = describe_memory(question, inner)
    size = describe_size(question, values[question.prefix + "size"])
    if question.operator == "curve":
        knots = [values[f"{question.prefix}knot_{k}"] for k in range(1, KNOTS + 1)]
        ends = sorted(values[question.prefix + "size"] * knot for knot in knots)
        low, high = (spell_quantity(end, question.location.unit) for end in (ends[0], ends[-1]))
        size = f"from {low} to {high}"
    return f"{article} {memory}, {size}"


def write_equation(question: Question) -> str:
    """Return the term's equation, in the symbols of its numbers."""
    symbol = {"command": "u", "position": "x", "pressure": "P_g", "velocity": "v", "time": "t"}
    q = symbol[question.driver]
    shape = {
        "constant": "1",
        "gain": f"{q} / Q",
        "curve": f"h({q})",
        "beyond": f"max({q} - w, 0) / Q",
        "wave": f"sin(2 pi {q} / w + phase)",
        "onset": f"[{q} > w]",
        "dead_zone": f"-clip({q}, -w, w) / Q",
        "saturation": f"(clip({q}, -w, w) - {q}) / Q",
        "lag": f"(z - {q}) / Q,  w z' = {q} - z",
        "play": f"(z - {q}) / Q,  |z - {q}| <= w / 2",
        "slew": f"(z - {q}) / Q,  |z'| <= w",
        "hysteresis": f"z,  dz = (sign(d{q}) - z) |d{q}| / w",
    }[question.operator]
    changes = question.location.unit == "1"
    place = question.location.name.replace("_", " ")
    return f"{place} (1 + size {shape})" if changes else f"{place} + size {shape}"
