"""Findings on paper: for a terminal, for `--json`, and their worst level."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from hal.doctor_finding import DoctorFinding, Level

__all__ = ["DoctorFinding", "Level", "encode_findings", "format_findings", "worst_level"]


def encode_findings(findings: Iterable[DoctorFinding]) -> list[dict[str, object]]:
    """Return the findings for `--json`."""
    return [finding._asdict() for finding in findings]


def worst_level(findings: Iterable[DoctorFinding]) -> Level:
    """Return the level of the worst finding; without findings all is well."""
    levels = {finding.level for finding in findings}
    return "fault" if "fault" in levels else "warning" if "warning" in levels else "ok"


def format_findings(findings: Iterable[DoctorFinding]) -> Iterator[str]:
    """Write a line for each finding; below each that is not ok, what it should be and the fix."""
    for finding in findings:
        yield f"{finding.level:<8} {finding.name:<22} {finding.found}"
        if finding.level != "ok":
            if finding.wanted:
                yield f"{'':<31} should be: {finding.wanted}"
            if finding.fix:
                yield f"{'':<31} fix: {finding.fix}"
