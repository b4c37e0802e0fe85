"""Where the files of a configuration are: those that pamctl brings, and those of the user.

No model is imported here: the help and the options of all verbs name these files.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

from pamctl.errors import ConfigError, Problem

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
