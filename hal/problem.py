"""What is wrong, said the same everywhere: of settings, logs, tables and rigs.

A place or a name, what is wrong, and the way on, in the message or beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

Level = Literal["ok", "note", "warning", "error", "fault"]
"""fault: a run would fail or would not be safe. warning: it would work, but worse."""
MISSING = "missing, and has no default"
"""Begins the message about a key that was not given."""


class Problem(NamedTuple):
    """What is wrong, or worth knowing."""

    where: str
    """`file:line:column`, the command-line option, or what was checked."""
    key: str
    """Dotted path from the section on, or a name that stays the same between versions, for scripts.

    Empty if the problem is a whole file.
    """
    message: str
    level: str = "error"
    """A `Level`."""
    wanted: str = ""
    """What it should be, where the message does not say it."""
    fix: str = ""
    """What to do, where the message does not say it; as a command where there is one."""
    data: Mapping[str, object] = {}
    """The figures behind the words, in SI, units in the names."""

    @property
    def is_missing(self) -> bool:
        """Whether a key without a default was not given."""
        return self.message.startswith(MISSING)

    def __str__(self) -> str:
        """Return the problem as one line for the user."""
        return ": ".join(part for part in self[:3] if part)

    @property
    def sentence(self) -> str:
        """What is wrong where, and what to do."""
        said = f"{self.where}: {self.message}" if self.where else self.message
        return f"{said}; {self.fix}" if self.fix else said

    def as_dict(self) -> dict[str, str]:
        """Return what a document holds."""
        return {"where": self.where, "key": self.key, "message": self.message}


def worst_level(problems: Iterable[Problem]) -> Level:
    """Return the level of the worst of some checks; without any all is well."""
    levels = {problem.level for problem in problems}
    return "fault" if "fault" in levels else "warning" if "warning" in levels else "ok"
