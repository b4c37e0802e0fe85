"""Text from outside, without what would steer a terminal or reorder what is read; and JSON.

A remark, a name or a log of somebody else may hold control characters: a terminal that prints an
escape sequence clears its screen, and a bidirectional override shows words in another order. They
are removed where text comes in, and again where it is shown: an old log may hold them.

JSON has no number that is not finite. A log has the string "nan", "inf" or "-inf" in its place.
These three strings are read back as floats, so no real text may be one of them.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TextIO
from unicodedata import category

_SEQUENCE = re.compile(
    r"(?:\x1b\]|\x9d)[^\x07\x1b\x9c]*(?:\x07|\x1b\\|\x9c)?"  # OSC: titles, links, the clipboard
    r"|(?:\x1b[PX^_]|[\x90\x98\x9e\x9f])[^\x1b\x9c]*(?:\x1b\\|\x9c)?"  # DCS, SOS, PM, APC
    r"|(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]?"  # CSI: colours, the cursor, the screen
    r"|\x1b[ -/]*[0-~]?"
)
"""The control sequences of ECMA-48."""

_UNSEEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 without tab and line feed, DEL, C1
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # marks and overrides of direction
    "\u200b\u2060-\u2064\ufeff\u2028\u2029"  # invisible, and separators of lines
    "\ud800-\udfff\U000e0000-\U000e007f]"  # halves of characters, tags
)


LONGEST_REMARK = 2000
"""Characters of a mark."""
LONGEST_NOTE = 2000
LONGEST_NAME = 200
MOST_TAGS = 64
_BREAKS = re.compile("[\t\n\v\f\r\x1c-\x1f\x85\u2028\u2029]+")
_CONTROLS = frozenset({"Cc", "Cf", "Cs"})
"""Control and format characters (bidirectional ones are among them), halves of characters."""
_JOINERS = frozenset("\N{ZERO WIDTH JOINER}\N{ZERO WIDTH NON-JOINER}")
"""Format characters that some languages need to be written."""


def clean_text(text: str) -> str:
    """Return a name or a remark as one line, without characters that cannot be seen."""
    line = _BREAKS.sub(" ", _SEQUENCE.sub("", text))
    return "".join(c for c in line if c in _JOINERS or category(c) not in _CONTROLS).strip()


def clean_lines(text: str) -> str:
    """Return a text without control characters; tabs and line ends stay."""
    return _UNSEEN.sub("", _SEQUENCE.sub("", text)) if _UNSEEN.search(text) else text


def clean_document(value: Any) -> Any:
    """Return what JSON held with every text in it cleaned, names included."""
    if isinstance(value, str):
        return clean_lines(value)
    if isinstance(value, Mapping):
        return {clean_document(name): clean_document(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [clean_document(part) for part in value]
    return value


def escape_name(name: str) -> str:
    r"""Return a file's name as one line of valid text, such as `caf\xe9.mcap`.

    A name is bytes to the file system: they may be no UTF-8, and hold a line break.
    """
    return name if name.isprintable() else "".join(map(_escape_character, name))


def _escape_character(character: str) -> str:
    if character.isprintable() or category(character) == "Zs" or character in _JOINERS:
        return character
    if "\udc80" <= character <= "\udcff":  # a byte that the file system's encoding lacks
        return f"\\x{ord(character) - 0xDC00:02x}"
    return character.encode("unicode_escape").decode()


class PlainStream:
    """Standard output or error that passes no control characters on, but a first return."""

    def __init__(self, stream: TextIO, before_write: Callable[[], None] = lambda: None) -> None:
        """Write to `stream`; all but `write` is its own. `before_write` is called before each."""
        self._before_write = before_write
        self.unfiltered = stream
        """What our own drawing of a whole screen writes to."""

    def write(self, text: str) -> int:
        """Write a text without its control characters; return its length."""
        self._before_write()
        again = "\r" if text.startswith("\r") else ""  # a progress line begins anew
        self.unfiltered.write(again + clean_lines(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.unfiltered, name)


def hint_at_nearest(name: str, known: Iterable[str]) -> str:
    """Return `; did you mean NAME?` of the nearest known name; empty if none is near."""
    from difflib import get_close_matches  # a name that is known needs none of it

    near = get_close_matches(name, known, n=1)
    return f"; did you mean {near[0]}?" if near and near[0] != name else ""


def count_of(count: int, noun: str) -> str:
    """Return `1 tick` or `2 ticks`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


# --- JSON ---------------------------------------------------------------------------------------

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
