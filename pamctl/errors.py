"""Settings that cannot be used, with all their problems."""

from __future__ import annotations

from collections.abc import Iterable

from hal.problem import Problem
from pamctl.exit_codes import ExitCode

__all__ = ["ConfigError", "Problem"]


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
