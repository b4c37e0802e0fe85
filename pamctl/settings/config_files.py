"""The files of a configuration: where they are, and the tables that they name.

No model is imported here: the help and the options of all verbs name these files.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pamctl.base.errors import ConfigError, Problem

if TYPE_CHECKING:
    from pamctl.settings.resolve import RawSettings
    from pamctl.settings.yaml12 import KeyPath

DEFAULT_NAMES: Mapping[str, str] = {
    "controller": "qsmc",
    "experiment": "tracking-2",
    "rig": "sim",
    "plant": "paper",
}
"""The defaults of `pamctl run`, by section; each section is a folder of `config/`."""


def config_dir() -> Path:
    """Return the folder of the shipped configuration, in an installed package or a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "_config"
    return installed if installed.is_dir() else package.parent / "config"


def list_shipped(section: str) -> list[str]:
    """Return the names of the shipped files of one section."""
    return sorted(path.stem for path in (config_dir() / section).glob("*.yaml"))


def find_config_file(section: str, name: str, option: str = "") -> Path:
    """Return the file for a name or path on the command line; raise `ConfigError`.

    `option` is the text before the name in messages [default: `--` and the section].
    """
    if Path(name).suffix in {".yaml", ".yml"} or Path(name).name != name:
        return Path(name)
    if name in list_shipped(section):
        return config_dir() / section / f"{name}.yaml"
    near = get_close_matches(name, list_shipped(section), n=1)
    meant = f"did you mean '{near[0]}'? There are" if near else "there are"
    listed = ", ".join(list_shipped(section)) or "none"
    message = f"there is no such {section}; {meant} {listed}; or give the path of a .yaml file"
    raise ConfigError([Problem(f"{option or f'--{section}'} {name}", "", message)])


# --- the files of tables -----------------------------------------------------------------------

_KINDS = ("table", "valve_table")


def read_section(section: str, path: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Return the checked keys of one file of a section, tables with their points.

    Raise `ConfigError`.
    """
    from pamctl.settings.resolve import read_section_file, settings_to_data

    return settings_to_data(read_section_file(section, path, overrides, read_tables))


def read_tables(raw: RawSettings, tell: Callable[[str], object] = lambda line: None) -> None:
    """Read the file of every table in raw settings; raise `ConfigError`, a line for each file.

    A file's place is from the folder of the experiment file that names it. `tell` gets a line for
    each table whose curve is far from what its points show.
    """
    problems: list[Problem] = []
    for at, table in _find_tables(raw.data, ()):
        # It needs numpy, which neither the daemon nor the start of a verb waits for.
        from pamctl.settings.table_points import read_points

        key = (*at, "file")
        origin = raw.origin(key)
        try:
            if doubt := read_points(table, _find_folder(origin) / str(table["file"])):
                tell(f"warning: {doubt}")
        except ValueError as error:
            problems.append(Problem(origin, ".".join(map(str, key)), str(error)))
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
