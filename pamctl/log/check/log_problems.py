"""What a tool has to say of a file: each finding with its weight and its place."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

MOST_OF_A_KIND = 20
"""A file that is wrong throughout is not told so a million times."""


class Severity(StrEnum):
    """How much a finding weighs."""

    ERROR = "error"
    """The file is not what it should be, or says what cannot be."""
    WARNING = "warning"
    """Something that a user of the file should know, and may live with."""
    NOTE = "note"
    """As it should be, and worth saying."""


class LogFinding(NamedTuple):
    """One thing that was found."""

    severity: Severity
    kind: str
    """A word that stays the same between versions, for scripts."""
    message: str


@dataclass
class LogFindings:
    """All that was found, in the order in which it was."""

    all: list[LogFinding] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)
    """How often each kind was found, told or not."""

    def error(self, kind: str, message: str) -> None:
        """Add an error."""
        self._add(LogFinding(Severity.ERROR, kind, message))

    def warning(self, kind: str, message: str) -> None:
        """Add a warning."""
        self._add(LogFinding(Severity.WARNING, kind, message))

    def note(self, kind: str, message: str) -> None:
        """Add a note."""
        self._add(LogFinding(Severity.NOTE, kind, message))

    def told(self) -> list[LogFinding]:
        """Return the findings, and of each kind that went on how often it did."""
        more = {kind: n - MOST_OF_A_KIND for kind, n in self.kinds.items() if n > MOST_OF_A_KIND}
        weights = {finding.kind: finding.severity for finding in self.all}
        rest = (
            LogFinding(weights[kind], kind, f"and {n} more of these") for kind, n in more.items()
        )
        return [*self.all, *rest]

    def any(self, severity: Severity) -> bool:
        """Tell whether there is a finding of this weight."""
        return any(finding.severity == severity for finding in self.all)

    def soften(self, kind: str) -> None:
        """Make warnings of the errors of a kind: something explains them."""
        self.all = [
            finding._replace(severity=Severity.WARNING) if finding.kind == kind else finding
            for finding in self.all
        ]

    def _add(self, finding: LogFinding) -> None:
        self.kinds[finding.kind] += 1
        if self.kinds[finding.kind] <= MOST_OF_A_KIND:
            self.all.append(finding)
