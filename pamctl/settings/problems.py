"""Problems of a configuration, in the words of the person who wrote it.

Pydantic finds the errors, and describes them and their places in its own terms. This module
translates: keys as in the file, bounds as a sentence, the nearest name for a typing error, and a
hint at the cause of a wrong value. Neither pydantic nor YAML is imported here.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, NamedTuple

from hal.problem import MISSING
from pamctl.base.texts import count_of

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from pamctl.settings.yaml12 import KeyPath

JsonSchema = dict[str, Any]


@dataclass(frozen=True)
class _Place:
    """The place of a pydantic error, followed through the JSON schema.

    Pydantic's locations name keys, but also the members of unions that it tried
    (`controller.qsmc.lambda_per_s`); the schema tells them apart.
    """

    schema: JsonSchema
    nodes: tuple[JsonSchema, ...]
    """The schemas of this place; several if the member of a union is unknown."""
    at: KeyPath = ()

    def step(self, name: str | int) -> _Place:
        if name == "[key]":  # pydantic marks an error in a key itself like this
            return self
        members = [member for node in self.nodes for member in self._members(node)]
        if any(len(self._members(node)) > 1 for node in self.nodes):
            named = [m for m in members if _is_called(m, name)]
            return _Place(self.schema, tuple(named or members), self.at)
        children = (_find_child(member, name) for member in members)
        return _Place(self.schema, tuple(c for c in children if c is not None), (*self.at, name))

    def names(self) -> list[str]:
        """Return the allowed keys of this place."""
        return list(dict.fromkeys(name for properties in self._properties() for name in properties))

    def description(self, name: str) -> str:
        """Return the model's description of one of its keys."""
        descriptions = (p[name].get("description", "") for p in self._properties() if name in p)
        return next(descriptions, "")

    def choices(self, tag: str) -> list[str]:
        """Return the allowed values of the key that distinguishes a union's members."""
        tags = (properties.get(tag, {}) for properties in self._properties())
        return [value for tag in tags for value in tag.get("enum", [tag.get("const")])]

    def _properties(self) -> list[JsonSchema]:
        members = (member for node in self.nodes for member in self._members(node))
        return [member.get("properties", {}) for member in members]

    def _members(self, node: JsonSchema) -> list[JsonSchema]:
        """Return the alternatives of a union without null, or else the node itself."""
        if "$ref" in node:
            return self._members(self.schema["$defs"][node["$ref"].rpartition("/")[2]])
        choices = node.get("oneOf", node.get("anyOf"))
        if choices is None:
            return [] if node.get("type") == "null" else [node]
        return [member for choice in choices for member in self._members(choice)]


def _is_called(member: JsonSchema, label: str | int) -> bool:
    properties = member.get("properties", {}).values()
    return label == member.get("title") or any(label == p.get("const") for p in properties)


def _find_child(node: JsonSchema, name: str | int) -> JsonSchema | None:
    if isinstance(name, str):
        others = node.get("additionalProperties")
        child = node.get("properties", {}).get(name, others if isinstance(others, dict) else None)
    else:
        leading = node.get("prefixItems", [])
        child = leading[name] if name < len(leading) else node.get("items")
    return child if isinstance(child, dict) else None


class _Complaint(NamedTuple):
    """One pydantic error: what the value must be, or else a complete message."""

    at: KeyPath
    must: str = ""
    message: str = ""
    got: object = None
    hint: str = ""
    meant: KeyPath | None = None
    """The key that was probably meant instead of an unknown one."""


def explain_errors(
    errors: Iterable[ErrorDetails], schema: JsonSchema, title: str
) -> dict[KeyPath, str]:
    """Describe each place's problem in one message, for all the alternatives that were tried."""
    complaints = [_make_complaint(error, schema, title) for error in errors]
    meant = {complaint.meant for complaint in complaints}
    found: dict[KeyPath, list[_Complaint]] = {}
    for complaint in complaints:
        if not (
            complaint.message.startswith(MISSING) and complaint.at in meant
        ):  # one mistake, one line
            found.setdefault(complaint.at, []).append(complaint)
    return {at: _join_complaints(at_one_place) for at, at_one_place in found.items()}


def _join_complaints(complaints: Sequence[_Complaint]) -> str:
    musts = list(dict.fromkeys(c.must for c in complaints if c.must))
    if not musts:
        return "; ".join(c.message for c in complaints)
    got = complaints[0].got
    habit = _hint_at_habit(musts, got)
    return f"must be {' or '.join(musts)} (got {_show_value(got)}){complaints[0].hint}{habit}"


def _make_complaint(error: ErrorDetails, schema: JsonSchema, title: str) -> _Complaint:
    kind, way, context = error["type"], error["loc"], error.get("ctx", {})
    if kind in {"extra_forbidden", "missing"}:
        return _explain_key(kind, _follow_location(schema, way[:-1]), way[-1], title)
    place = _follow_location(schema, way)
    if kind in {"union_tag_not_found", "union_tag_invalid"}:
        return _explain_tag(place, context["discriminator"].strip("'"), error["input"])
    if kind in {"value_error", "assertion_error"}:
        return _Complaint(place.at, message=str(context["error"]))
    if kind in {"too_short", "too_long"}:
        bound, name = ("least", "min") if kind == "too_short" else ("most", "max")
        items = count_of(context[f"{name}_length"], "item")
        message = f"must hold at {bound} {items} (got {context['actual_length']})"
        return _Complaint(place.at, message=message)
    if kind in _MUST:
        numbers = {k: f"{v:g}" if isinstance(v, float) else v for k, v in context.items()}
        return _Complaint(place.at, _MUST[kind].format(**numbers), got=error["input"])
    said = error["msg"]
    must = said.removeprefix("Input should be ").replace("valid ", "")
    return _Complaint(place.at, must if must != said else "", said, error["input"])


def names_in(schema: JsonSchema) -> set[str]:
    """Return the allowed keys of a schema's mappings."""
    return set(_follow_location(schema, ()).names())


def _follow_location(schema: JsonSchema, way: Iterable[str | int]) -> _Place:
    place = _Place(schema, (schema,))
    for name in way:
        place = place.step(name)
    return place


def _explain_key(kind: str, parent: _Place, key: str | int, title: str) -> _Complaint:
    at = (*parent.at, key)
    if isinstance(key, int):
        return _Complaint(parent.at, message=f"must hold more than {count_of(key, 'item')}")
    if kind == "missing":
        about = parent.description(key)
        return _Complaint(at, message=f"{MISSING} ({about})" if about else MISSING)
    if (title, *at) in {(key, key), ("", key, key)}:
        message = f"unknown key; the keys of a {key} file have no heading"
        return _Complaint(at, message=message)
    if gone := _GONE.get((title, *at) if title else at):
        return _Complaint(at, message=f"unknown key: {gone}")
    meant, hint = _guess_key(key, parent.names())
    return _Complaint(at, message=f"unknown key{hint}", meant=(*parent.at, meant))


_GONE: Mapping[KeyPath, str] = {
    ("plant", "correction"): "tables without a name are gone; run `pamctl diagnose` again, which "
    "describes what no effect explains as a term, or delete the key to go on without the table",
}
"""What to do about keys that older versions had, by section and key."""


def _explain_tag(place: _Place, tag: str, given: Any) -> _Complaint:
    at = (*place.at, tag)
    expected = join_choices(place.choices(tag))
    if tag not in given:
        return _Complaint(at, message=f"missing; it must be {expected}")
    value = given[tag]
    why = _explain_unknown(tag, value) if isinstance(value, str) else ""
    return _Complaint(at, must=expected, got=value, hint=f"; {why}" if why else "")


def _explain_unknown(tag: str, name: str) -> str:
    """Return why a name is not among the choices, where packages offer more of them."""
    if tag == "backend":
        from hal.backend import hint_at_missing

        return hint_at_missing(name)
    if tag == "law":
        from pamctl.control.law_registry import explain_missing_law

        return explain_missing_law(name)
    return ""


# --- words -----------------------------------------------------------------------------

_NUMBER, _WHOLE, _TRUTH, _TEXT = "a number", "a whole number", "true or false", "text"
_LIST, _MAPPING = "a list", "a mapping of keys to values"
_MUST = {
    "bool_type": _TRUTH,
    "dict_type": _MAPPING,
    "enum": "{expected}",
    "finite_number": "a finite number",
    "float_type": _NUMBER,
    "frozen_set_type": _LIST,
    "greater_than": "greater than {gt}",
    "greater_than_equal": "at least {ge}",
    "int_from_float": _WHOLE,
    "int_type": _WHOLE,
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "list_type": _LIST,
    "literal_error": "{expected}",
    "model_attributes_type": _MAPPING,
    "model_type": _MAPPING,
    "multiple_of": "a multiple of {multiple_of}",
    "none_required": "null",
    "set_type": _LIST,
    "string_pattern_mismatch": "text of the form {pattern}",
    "string_too_long": "text of at most {max_length} characters",
    "string_too_short": "text of at least {min_length} characters",
    "string_type": _TEXT,
    "tuple_type": _LIST,
}
"""Pydantic's error types, as the rest of a sentence that begins with `must be`."""

_UNIT = re.compile(
    r"per|length|(?:[muk]?m|inch|in|s)[23]?|[mun]s|min|k?hz|rad|deg|m?n|k?g|[km]?pa|bar|psi|atm"
    r"|m?v|k|c|j|counts?|ticks?|percent"
)


def _strip_unit(key: str) -> str:
    """Return a key without the unit at its end: `lambda` for `lambda_per_s`."""
    parts = key.lower().split("_")
    while len(parts) > 1 and _UNIT.fullmatch(parts[-1]):
        parts.pop()
    return "_".join(parts)


def _guess_key(key: str, known: Sequence[str]) -> tuple[str, str]:
    """Return the key that was probably meant ('' if none is near), and a hint."""
    stems = {_strip_unit(name): name for name in reversed(known)}
    if _strip_unit(key) in stems and key not in known:
        name = stems[_strip_unit(key)]
        return name, f"; did you mean '{name}'? The unit is part of the name"
    near = get_close_matches(key.lower(), known, n=1) or [
        stems[stem] for stem in get_close_matches(_strip_unit(key), stems, n=1)
    ]
    if near:
        return near[0], f"; did you mean '{near[0]}'?"
    return "", f"; there are {', '.join(known)}" if 0 < len(known) <= 12 else ""


def join_choices(values: Iterable[object]) -> str:
    """Write alternatives: `'a', 'b' or 'c'`."""
    *first, last = (f"'{value}'" if isinstance(value, str) else str(value) for value in values)
    return f"{', '.join(first)} or {last}" if first else last


def _show_value(value: object) -> str:
    """Show a value as the user wrote it, or its kind."""
    if value is None or isinstance(value, dict):
        return "nothing" if value is None else "a mapping"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value}".replace("nan", ".nan").replace("inf", ".inf")
    written = repr(value) if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return written if len(written) <= 40 else f"{written[:37]}..."


def _hint_at_habit(musts: Sequence[str], got: object) -> str:
    """Hint at a common cause of a wrong value."""
    if got is None and _MAPPING in musts:
        return "; leave the key out, or write {}"
    if not isinstance(got, str):
        return ""
    if _TRUTH in musts and got.lower() in {"on", "off", "yes", "no", "y", "n"}:
        return "; YAML 1.2 knows only true and false"
    if _NUMBER not in musts and _WHOLE not in musts:
        return ""
    if re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", got):
        return "; leave out the quotes"
    if re.fullmatch(r"[-+]?\d+,\d+", got):
        return "; write the decimals after a point"
    if re.match(r"[-+]?[\d.]+\s*[^\d\s]", got):
        return "; a bare number, in the unit that the key names"
    return ""


def join_key_path(at: KeyPath) -> str:
    """Write a path of keys as a user does: `controller.lambda_per_s`."""
    return ".".join(map(str, at))
