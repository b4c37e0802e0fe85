"""The findings of a check: each with its severity, kind and place."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

MOST_OF_A_KIND = 20
"""Findings of one kind that are listed one by one; the rest is only counted."""


class Severity(StrEnum):
    """The severity of a finding."""

    ERROR = "error"
    """The file is wrong, or holds impossible values."""
    WARNING = "warning"
    """A user of the file should know this, but the file is usable."""
    NOTE = "note"
    """Nothing is wrong, but it is worth mentioning."""


class LogFinding(NamedTuple):
    """One finding."""

    severity: Severity
    kind: str
    """A name that stays the same between versions, for scripts."""
    message: str


@dataclass
class LogFindings:
    """All findings, in the order in which they were made."""

    all: list[LogFinding] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)
    """Number of findings of each kind, listed or not."""

    def error(self, kind: str, message: str) -> None:
        """Add an error."""
        self._add(LogFinding(Severity.ERROR, kind, message))

    def warning(self, kind: str, message: str) -> None:
        """Add a warning."""
        self._add(LogFinding(Severity.WARNING, kind, message))

    def note(self, kind: str, message: str) -> None:
        """Add a note."""
        self._add(LogFinding(Severity.NOTE, kind, message))

    def summarise(self) -> list[LogFinding]:
        """Return the findings, and for each kind with too many the number of the rest."""
        more = {kind: n - MOST_OF_A_KIND for kind, n in self.kinds.items() if n > MOST_OF_A_KIND}
        weights = {finding.kind: finding.severity for finding in self.all}
        rest = (
            LogFinding(weights[kind], kind, f"and {n} more of these") for kind, n in more.items()
        )
        return [*self.all, *rest]

    def any(self, severity: Severity) -> bool:
        """Tell whether there is a finding of this severity."""
        return any(finding.severity == severity for finding in self.all)

    def soften(self, kind: str) -> None:
        """Turn errors of a kind into warnings: something else explains them."""
        self.all = [
            finding._replace(severity=Severity.WARNING) if finding.kind == kind else finding
            for finding in self.all
        ]

    def _add(self, finding: LogFinding) -> None:
        self.kinds[finding.kind] += 1
        if self.kinds[finding.kind] <= MOST_OF_A_KIND:
            self.all.append(finding)
