"""What is wrong, said the same everywhere: of settings, logs, tables and rigs.

A place or a name, what is wrong, and the way on, in the message or beside it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from pamctl.exit_codes import ExitCode

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
    """`ok`, `note`, `warning`, `error` or `fault`."""
    wanted: str = ""
    """What it should be, where the message does not say it."""
    fix: str = ""
    """What to do, where the message does not say it."""

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


class ConfigError(Exception):
    """Settings that cannot be used, with all their problems."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        """Keep the problems; the message has one line each."""
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))

    @property
    def exit_code(self) -> ExitCode:
        """2 where only options are wrong, 78 where a file or a setting is."""
        places = [problem.where for problem in self.problems]
        options_only = all(at.startswith("--") and not at.startswith("--set") for at in places)
        return ExitCode.USAGE if options_only else ExitCode.BAD_CONFIG
