"""Read the points of a table's file into the settings: the run needs the file no more."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pamctl.errors import ConfigError, Problem
from pamctl.settings.problems import join_key_path
from pamctl.settings.resolve import RawSettings
from pamctl.settings.yaml12 import KeyPath

_KINDS = ("table", "valve_table")


def read_tables(raw: RawSettings) -> None:
    """Read the file of every table in raw settings; raise `ConfigError`, a line for each file.

    A file's place is from the folder of the experiment file that names it.
    """
    problems: list[Problem] = []
    for at, table in _find_tables(raw.data, ()):
        # It needs numpy, which neither the daemon nor the start of a verb waits for.
        from pamctl.settings.table_points import read_points

        key = (*at, "file")
        origin = raw.origin(key)
        try:
            read_points(table, _find_folder(origin) / str(table["file"]))
        except ValueError as error:
            problems.append(Problem(origin, join_key_path(key), str(error)))
    if problems:
        raise ConfigError(problems)


def _find_tables(data: Any, at: KeyPath) -> Iterator[tuple[KeyPath, dict[str, Any]]]:
    if isinstance(data, dict):
        if data.get("kind") in _KINDS and isinstance(data.get("file"), str) and "t_s" not in data:
            yield at, data
        for name, value in data.items():
            yield from _find_tables(value, (*at, name))
    elif isinstance(data, list):
        for index, value in enumerate(data):
            yield from _find_tables(value, (*at, index))


def _find_folder(origin: str) -> Path:
    """Return the folder of the file in which a value was written; else the working folder."""
    written = re.fullmatch(r"(.+\.ya?ml):\d+:\d+", origin)
    return Path(written[1]).parent if written else Path()
