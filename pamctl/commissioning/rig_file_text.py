"""The text of a rig file with values put in; its comments and order stay."""

from __future__ import annotations

import copy
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.settings.yaml12 import YamlError, dump_yaml, parse_yaml


class RigValue(NamedTuple):
    """One value for the rig file, with its uncertainty."""

    keys: tuple[str, str]
    """Section and key."""
    value: float
    unit: str
    uncertainty: float
    """Two standard deviations, of one measurement alone; 0 for what is exact."""
    how: str


def insert_values(text: str, values: Sequence[RigValue], notes: Sequence[str]) -> str:
    """Return the text of a rig file with values put in.

    The notes become comments at the top; the first begins with the date and gives the command and
    the source file. A comment above each value says how it was found.
    """
    wanted = _change_data(parse_yaml(text, Path("rig file")).data, values)
    edited = text
    for value in values:
        edited = _edit_line(edited, value, notes[0])
    found: object = None
    with suppress(YamlError):
        found = parse_yaml(edited, Path("rig file")).data
    if found != wanted:  # written in a way that lines cannot follow: flow style, anchors
        edited = dump_yaml(wanted)
    # The notes stand below the comments that the file begins with.
    lines = edited.splitlines()
    first = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    lines[first:first] = [f"# {note}" for note in notes]
    return "\n".join(lines) + "\n"


def _change_data(data: dict[str, object], values: Sequence[RigValue]) -> dict[str, Any]:
    changed: dict[str, Any] = copy.deepcopy(data)
    for value in values:
        section, key = value.keys
        changed[section] = {**(changed.get(section) or {}), key: value.value}
    return changed


def _edit_line(text: str, value: RigValue, heading: str) -> str:
    """Change or add one line, with a comment above it."""
    section, key = value.keys
    marks = parse_yaml(text, Path("rig file")).marks
    lines = text.splitlines()
    if value.keys in marks:
        at = marks[value.keys].line - 1
        old = re.match(rf"(\s*{key}\s*:\s*)([^\s#]*)(.*)", lines[at])
        if old is None:
            return text
        before, was, after = old.groups()
        indent = re.match(r"\s*", before)
        assert indent is not None
        comment = f"{indent[0]}# {_describe_value(value, heading)}; was {was}"
        lines[at : at + 1] = [comment, f"{before}{_format_value(value)}{after}"]
        return "\n".join(lines) + "\n"
    if (section,) not in marks:
        lines += [
            f"{section}:",
            f"  # {_describe_value(value, heading)}",
            f"  {key}: {_format_value(value)}",
        ]
        return "\n".join(lines) + "\n"
    at = marks[(section,)].line
    columns = [mark.column for at, mark in marks.items() if len(at) == 2 and at[0] == section]
    indent_text = " " * (min(columns, default=3) - 1)
    lines[at:at] = [
        f"{indent_text}# {_describe_value(value, heading)}; was the default",
        f"{indent_text}{key}: {_format_value(value)}",
    ]
    return "\n".join(lines) + "\n"


def _describe_value(value: RigValue, heading: str) -> str:
    date = heading.split(maxsplit=1)[0]
    within = f", +-{value.uncertainty:.2g} {value.unit}" if value.uncertainty else ""
    return f"{date}: {value.how}{within}"


def _format_value(value: RigValue) -> str:
    return f"{value.value:d}" if isinstance(value.value, int) else repr(value.value)
