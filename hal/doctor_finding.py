"""One line of a doctor's report: what was checked, what was found, what to do.

A backend checks its own device and reports in this form; `pamctl doctor` prints it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

from hal.rig import RigError

Level = Literal["ok", "warning", "fault"]
"""fault: a run would fail or would not be safe. warning: a run would work, but worse."""


class DoctorFinding(NamedTuple):
    """One check and its result; `name` is stable between versions."""

    name: str
    level: Level
    found: str
    wanted: str = ""
    """What it should be; empty where all is well."""
    fix: str = ""
    """What to do, as a command where there is one."""
    data: Mapping[str, object] = {}
    """The figures behind the words, in SI, units in the names."""


def report_rig_error(name: str, error: RigError, wanted: str) -> DoctorFinding:
    """Return a check that ended in an error of the device, with the fix that the error names."""
    return DoctorFinding(name, "fault", describe_rig_error(error), wanted, error.fix)


def describe_rig_error(error: RigError) -> str:
    """Return what the device reports, with its error number and without the fix."""
    return error.what if error.code is None else f"{error.what} (device error {error.code})"
