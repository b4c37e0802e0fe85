"""`pamctl diagnose --on-rig`: ask before the first motion, run the rounds, keep what was found."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from pamctl.cli.failure import Failed, print_error
from pamctl.cli.output import print_json, print_result
from pamctl.exit_codes import ExitCode
from pamctl.plant.model import PlantSettings


@dataclass(frozen=True)
class OnRigTask:
    """What was asked for on the command line."""

    logs: Sequence[Path]
    out: Path | None
    """None for a dry run."""
    start: PlantSettings
    experiment: str
    runs: int
    minutes: float
    socket: Path | None
    dry_run: bool
    yes: bool


def diagnose_on_rig(task: OnRigTask, *, as_json: bool) -> None:
    """Run the rounds on the daemon's rig; write and print what was found, however they end."""
    from pamctl.commissioning.bench import Terminal
    from pamctl.diagnose.record import record_of
    from pamctl.on_rig.decide_on_rig import Investigation, write_investigation
    from pamctl.on_rig.rig_plan import Budget, make_rig_plan
    from pamctl.session.daemon_rig import connect

    records = [record_of(path) for path in task.logs]
    with connect(task.socket) as rig:
        first = None if records else task.experiment
        budget = Budget(task.runs, task.minutes)
        plan = make_rig_plan(rig.settings(), task.start, first, budget)
        if task.dry_run:
            if as_json:
                print_json(plan.as_dict())
            else:
                typer.echo(plan.describe())
            return
        print(plan.describe(), file=sys.stderr)
        if not task.yes:
            Terminal().require_yes("May the rig be pressurised and move?")
        investigation = Investigation(plan, records)
        assert task.out is not None
        try:
            code, reason = _run_rounds(rig, investigation)
        except Exception as error:  # a fault of the program: the document holds what was found
            investigation.stopped = f"the program failed: {type(error).__name__}: {error}"
            write_investigation(investigation, task.out)
            raise
    _finish(investigation, task, code, reason, as_json=as_json)


def _run_rounds(rig: Any, investigation: Any) -> tuple[ExitCode, str]:
    """Return how the rounds ended; the rig is left, stopped and safe, when this returns."""
    from pamctl.on_rig.decide_on_rig import decide_on_rig
    from pamctl.session.pamctl_error import PamctlError

    def progress(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    try:
        with (
            end_on_signals(),
            rig,
        ):  # a daemon that cannot be left well ends the rounds, and loses none of them
            decide_on_rig(rig, investigation, progress=progress)
    except KeyboardInterrupt as interrupt:
        investigation.stopped = "it was interrupted"
        code = ExitCode.SIGTERM if isinstance(interrupt, _Terminated) else ExitCode.SIGINT
        return code, "interrupted"
    except PamctlError as error:
        investigation.stopped = f"the run failed: {error.reason}"
        return error.exit_code, error.reason
    bad = investigation.diagnosis is not None and investigation.diagnosis.reason
    return (ExitCode.BAD_DATA if bad else ExitCode.OK), ""


class _Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP: the rounds end as after Ctrl-C."""


@contextmanager
def end_on_signals() -> Iterator[None]:
    """End the block by an exception on SIGTERM and SIGHUP, so that the rig is left as it should."""

    def end(number: int, frame: object) -> None:
        raise _Terminated

    before = {n: signal.signal(n, end) for n in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _finish(
    investigation: Any, task: OnRigTask, code: ExitCode, reason: str, *, as_json: bool
) -> None:
    """Write the folder and print the result; the document is there as far as it is."""
    from pamctl.diagnose import summary
    from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
    from pamctl.new_file import NewFileError
    from pamctl.on_rig.decide_on_rig import write_investigation

    assert task.out is not None
    found = investigation.diagnosis
    if found is None:
        raise Failed(code, f"{reason}; nothing was diagnosed yet")
    failure, end = None, ""
    try:
        end = f"\n\n{task.out}: {', '.join(write_investigation(investigation, task.out))}"
    except NewFileError as error:
        failure = error
    told = "\n".join(
        f"round {each.number}: {each.program or 'given logs'}: {each.diagnosis.verdict.value}"
        for each in investigation.rounds
    )
    stopped = f"stopped after {investigation.rig_time_s:.0f} s on the rig: {investigation.stopped}"
    document = {**build_diagnosis_document(found), "on_rig": investigation.as_dict()}
    text = f"{summary(found)}\n\n{told}\n{stopped}{end}"
    print_result(document, lambda: text, failure, as_json=as_json)
    if reason:
        print_error(reason)
    raise typer.Exit(code)
