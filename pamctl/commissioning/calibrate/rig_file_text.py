"""Put new values into the text of a rig file; its comments and order stay."""

from __future__ import annotations

import copy
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pamctl.commissioning.calibrate.outcome import CalibrationOutcome, CalibrationValue
from pamctl.settings.yaml12 import FilePosition, KeyPath, dump_yaml, parse_yaml


def insert_values(text: str, outcome: CalibrationOutcome, heading: str) -> str:
    """Return the text of a rig file with the values of a calibration put in.

    `heading` gives the time, the command and the source file; heading and notes become comments at
    the top. A comment above each value says how it was found.
    """
    wanted = _change_data(parse_yaml(text, Path("rig file")).data, outcome.values)
    edited = text
    for value in outcome.values:
        edited = _edit_line(edited, value, heading)
    if (
        _parse_data(edited) != wanted
    ):  # written in a way that lines cannot follow: flow style, anchors
        edited = dump_yaml(wanted)
    return _add_notes(edited, [heading, *outcome.notes])


def _change_data(data: dict[str, object], values: Sequence[CalibrationValue]) -> dict[str, Any]:
    changed: dict[str, Any] = copy.deepcopy(data)
    for value in values:
        section, key = value.keys
        changed[section] = {**(changed.get(section) or {}), key: value.value}
    return changed


def _parse_data(text: str) -> dict[str, Any] | None:
    from pamctl.settings.yaml12 import YamlError

    try:
        return parse_yaml(text, Path("rig file")).data
    except YamlError:
        return None


def _edit_line(text: str, value: CalibrationValue, heading: str) -> str:
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
    indent_text = " " * _find_indent(marks, section)
    lines[at:at] = [
        f"{indent_text}# {_describe_value(value, heading)}; was the default",
        f"{indent_text}{key}: {_format_value(value)}",
    ]
    return "\n".join(lines) + "\n"


def _find_indent(marks: dict[KeyPath, FilePosition], section: str) -> int:
    columns = [mark.column for at, mark in marks.items() if len(at) == 2 and at[0] == section]
    return min(columns, default=3) - 1


def _describe_value(value: CalibrationValue, heading: str) -> str:
    date = heading.split(maxsplit=1)[0]
    within = f", +-{value.uncertainty:.2g} {value.unit}" if value.uncertainty else ""
    return f"{date}: {value.how}{within}"


def _format_value(value: CalibrationValue) -> str:
    return f"{value.value:d}" if isinstance(value.value, int) else repr(value.value)


def _add_notes(text: str, notes: Sequence[str]) -> str:
    """Put notes below the comments that a file begins with."""
    lines = text.splitlines()
    first = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    lines[first:first] = [f"# {note}" for note in notes]
    return "\n".join(lines) + "\n"
