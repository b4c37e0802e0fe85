"""A finding: what was looked at, what was found, what it should be, what to do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Literal, NamedTuple

from hal.rig import RigError

Level = Literal["ok", "warning", "fault"]
"""fault: a run would fail, or would not be safe. warning: it would work, but worse."""


class DoctorFinding(NamedTuple):
    """One line of the doctor's report; `name` is stable between versions."""

    name: str
    level: Level
    found: str
    wanted: str = ""
    """What it should be; empty where all is well."""
    fix: str = ""
    """What to do, a command where there is one."""
    data: Mapping[str, object] = {}
    """The figures behind the words, in SI, units in the names."""


def describe_rig_error(error: RigError) -> str:
    """Return what a device says is wrong, with its number: the fix has a place of its own."""
    return error.what if error.code is None else f"{error.what} (device error {error.code})"


def encode_findings(findings: Iterable[DoctorFinding]) -> list[dict[str, object]]:
    """Return the findings for `--json`."""
    return [finding._asdict() for finding in findings]


def worst_level(findings: Iterable[DoctorFinding]) -> Level:
    """Return the level of the worst finding; no finding is no fault."""
    levels = {finding.level for finding in findings}
    return "fault" if "fault" in levels else "warning" if "warning" in levels else "ok"


def format_findings(findings: Iterable[DoctorFinding]) -> Iterator[str]:
    """Write the findings for a terminal, a line each, and the way out below each that is not ok."""
    for finding in findings:
        yield f"{finding.level:<8} {finding.name:<22} {finding.found}"
        if finding.level != "ok":
            if finding.wanted:
                yield f"{'':<31} should be: {finding.wanted}"
            if finding.fix:
                yield f"{'':<31} fix: {finding.fix}"
