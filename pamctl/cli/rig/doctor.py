"""`pamctl doctor`: are this PC and this rig fit for a run? Each fault comes with its fix."""

from __future__ import annotations

import sys
from contextlib import closing
from typing import TYPE_CHECKING

import typer

from hal.backend import DoctorFinding, worst_level
from pamctl.cli.options import flag, option, require_linux, verb
from pamctl.cli.output import print_result
from pamctl.cli.settings_from_options import RigOptions
from pamctl.errors import Problem
from pamctl.exit_codes import ExitCode

if TYPE_CHECKING:
    from pamctl.processes.interrupts import SignalInterrupt

SCHEMA = 1
"""Version of the document that `--json` prints."""


class DoctorOptions(RigOptions):
    """`pamctl doctor`."""

    actuate: bool = flag("--actuate", "Fill and exhaust for a moment; the muscle moves")
    rt_seconds: float = option(
        "--rt-seconds SECONDS", "Duration of each measurement of wake-ups", 2.0, low=0.1, high=600.0
    )


@verb
def doctor(asked: DoctorOptions) -> None:
    """Check whether this PC and this rig are fit for a run, with a fix for each fault."""
    settings, _ = asked.resolve()
    require_linux()
    from pamctl.commissioning.examination import examine_all
    from pamctl.processes.backends import device_of
    from pamctl.processes.interrupts import SignalInterrupt
    from pamctl.report.report import Problems, format_part

    findings: list[DoctorFinding] = []
    interrupt: SignalInterrupt | None = None
    # A simulated carriage cannot be moved by hand.
    may_ask = not asked.as_json and sys.stdin.isatty() and not settings.rig.record.is_simulated
    work = examine_all(settings, asked.rt_seconds, actuate=asked.actuate, may_ask=may_ask)
    try:
        # Closed on every path: it holds the rig.
        with closing(work):
            for finding in work:
                findings.append(finding)
                if not asked.as_json:
                    typer.echo(format_part(Problems([_to_problem(finding)])))
    except (SignalInterrupt, KeyboardInterrupt) as error:
        interrupt = error if isinstance(error, SignalInterrupt) else SignalInterrupt(2)
    code = _exit_code(findings, interrupt)
    document = {
        "schema": SCHEMA,
        "exit_code": code,
        "worst": worst_level(findings),
        "backend": settings.rig.backend,
        "device": device_of(settings),
        "actuated": asked.actuate,
        "findings": [finding._asdict() for finding in findings],
    }
    levels = [finding.level for finding in findings]
    verdict = f"{levels.count('fault')} faults, {levels.count('warning')} warnings"
    print_result(document, str(interrupt or verdict), as_json=asked.as_json)
    raise typer.Exit(code)


def _exit_code(findings: list[DoctorFinding], interrupt: SignalInterrupt | None) -> int:
    if interrupt is not None:
        return interrupt.code
    return int(ExitCode.CHECK_FAILED if worst_level(findings) == "fault" else ExitCode.OK)


def _to_problem(finding: DoctorFinding) -> Problem:
    return Problem(finding.name, "", finding.found, finding.level, finding.wanted, finding.fix)
