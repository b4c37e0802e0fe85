"""What installed packages add to pamctl, by entry point group.

Pamctl's own additions are entry points too. In a checkout they are read from its pyproject.toml:
an editable install that is older than the checkout does not list them all.
"""

from __future__ import annotations

import tomllib
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NamedTuple

from pamctl import __version__

OWN_PACKAGE = "pamctl"


class Addition(NamedTuple):
    """One entry point, not yet loaded."""

    name: str
    target: str
    """`module:attribute`."""
    package: str
    """Name of the distribution that brings it."""
    version: str

    @property
    def module(self) -> str:
        """The module that defines it."""
        return self.target.partition(":")[0]

    def load(self) -> Any:
        """Import its module and return the object; raise whatever that raises."""
        return getattr(import_module(self.module), self.target.partition(":")[2])


def list_additions(group: str) -> list[Addition]:
    """Return the entry points of a group, those of pamctl first."""
    installed = [
        Addition(point.name, point.value, point.dist.name, point.dist.version)
        for point in metadata.entry_points(group=group)
        if point.dist is not None
    ]
    own = _read_checkout(group) or [one for one in installed if one.package == OWN_PACKAGE]
    return own + [one for one in installed if one.package != OWN_PACKAGE]


def _read_checkout(group: str) -> list[Addition]:
    """Return what the checkout's pyproject.toml lists; nothing where pamctl is installed."""
    try:
        text = (Path(__file__).parent.parent / "pyproject.toml").read_text()
        project = tomllib.loads(text)["project"]
    except (OSError, ValueError, KeyError):
        return []
    if project["name"] != OWN_PACKAGE:
        return []
    points = project.get("entry-points", {}).get(group, {})
    return [Addition(name, target, OWN_PACKAGE, __version__) for name, target in points.items()]
