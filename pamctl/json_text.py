"""JSON of the log, with a rule for numbers that JSON does not have.

A float that is not finite is written as the string "nan", "inf" or "-inf". These three strings
are read back as floats, so no real text may be one of them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def to_json(value: object) -> bytes:
    """Write a value as valid JSON; unknown types are written as their text."""
    try:
        return _dump(value)
    except ValueError:
        return _dump(_spell_out(value))


def from_json(text: bytes | str) -> Any:
    """Read the output of `to_json`; raise ValueError if it is not JSON."""
    return _restore(json.loads(text))


def to_plain_json(value: Any) -> str:
    """Write JSON for any reader: a number that is not finite is null."""
    return json.dumps(replace_nan(value), separators=(",", ":"), allow_nan=False)


def replace_nan(value: Any) -> Any:
    """Return a document with None in place of each number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: replace_nan(part) for name, part in value.items()}
    return [*map(replace_nan, value)] if isinstance(value, list | tuple) else value


def _dump(value: object) -> bytes:
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), default=_make_plain)
    return text.encode()


def _make_plain(value: object) -> object:
    if isinstance(value, Mapping):
        return dict(value)
    item = getattr(value, "item", None)
    return item() if callable(item) else str(value)


def _spell_out(value: object) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else str(float(value))
    if isinstance(value, Mapping):
        return {name: _spell_out(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_spell_out(part) for part in value]
    if value is None or isinstance(value, int | str):
        return value
    return _spell_out(_make_plain(value))


def _restore(value: Any) -> Any:
    if isinstance(value, str):
        return _NOT_FINITE.get(value, value)
    if isinstance(value, dict):
        return {name: _restore(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_restore(part) for part in value]
    return value


def flatten_keys(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings by dotted key; an empty mapping is a value."""
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from flatten_keys(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value
