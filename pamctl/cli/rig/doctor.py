"""`pamctl doctor`: are this PC and this rig fit for a run? Each fault comes with its fix."""

from __future__ import annotations

import sys
from contextlib import closing
from typing import TYPE_CHECKING, Annotated

import typer

from hal.backend import (
    DoctorFinding,
    format_findings,
    worst_level,
)
from pamctl.cli.backend_option import BackendOption
from pamctl.cli.options import JsonOption, RigOption, SetOption, require_linux
from pamctl.cli.output import print_json
from pamctl.cli.settings_from_options import resolve_options
from pamctl.exit_codes import ExitCode

if TYPE_CHECKING:
    from pamctl.processes.interrupts import SignalInterrupt

SCHEMA = 1
"""Version of the document that `--json` prints."""


def doctor(
    backend: BackendOption = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    actuate: Annotated[
        bool, typer.Option("--actuate", help="Fill and exhaust for a moment; the muscle moves")
    ] = False,
    rt_seconds: Annotated[
        float,
        typer.Option(
            "--rt-seconds",
            metavar="SECONDS",
            min=0.1,
            max=600.0,
            help="Duration of each measurement of wake-ups",
        ),
    ] = 2.0,
    as_json: JsonOption = False,
) -> None:
    """Check whether this PC and this rig are fit for a run, with a fix for each fault."""
    settings, _ = resolve_options(backend, rig, overrides, fast=False)
    require_linux()
    from pamctl.commissioning.examination import examine_all
    from pamctl.processes.backends import device_of
    from pamctl.processes.interrupts import SignalInterrupt

    findings: list[DoctorFinding] = []
    interrupt: SignalInterrupt | None = None
    # A simulated carriage cannot be moved by hand.
    may_ask = not as_json and sys.stdin.isatty() and not settings.rig.record.is_simulated
    work = examine_all(settings, rt_seconds, actuate=actuate, may_ask=may_ask)
    try:
        # Closed on every path: it holds the rig.
        with closing(work):
            for finding in work:
                findings.append(finding)
                if not as_json:
                    typer.echo("\n".join(format_findings([finding])))
    except (SignalInterrupt, KeyboardInterrupt) as error:
        interrupt = error if isinstance(error, SignalInterrupt) else SignalInterrupt(2)
    code = _exit_code(findings, interrupt)
    if as_json:
        document = {
            "schema": SCHEMA,
            "exit_code": code,
            "worst": worst_level(findings),
            "backend": settings.rig.backend,
            "device": device_of(settings),
            "actuated": actuate,
            "findings": [finding._asdict() for finding in findings],
        }
        print_json(document)
    else:
        typer.echo(str(interrupt) if interrupt else _summarise(findings))
    raise typer.Exit(code)


def _exit_code(findings: list[DoctorFinding], interrupt: SignalInterrupt | None) -> int:
    if interrupt is not None:
        return interrupt.code
    return int(ExitCode.CHECK_FAILED if worst_level(findings) == "fault" else ExitCode.OK)


def _summarise(findings: list[DoctorFinding]) -> str:
    levels = [finding.level for finding in findings]
    return f"{levels.count('fault')} faults, {levels.count('warning')} warnings"
