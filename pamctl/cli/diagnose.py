"""`pamctl diagnose`: which effect does the model lack? Of logs, or in rounds on the rig.

On the rig it asks before the first motion, runs the rounds, and keeps what was found.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from pamctl.cli.failure import Failed, print_error
from pamctl.cli.options import (
    INTERACTIVE,
    JOBS,
    MAP,
    MAY_MOVE,
    SOCKET,
    DataOptions,
    argument,
    flag,
    option,
    require_linux,
    verb,
)
from pamctl.cli.output import print_report, print_result, read_records, tell
from pamctl.exit_codes import ExitCode
from pamctl.new_file import NewFileError, require_empty_folder
from pamctl.plain_text import hint_at_nearest

if TYPE_CHECKING:
    from pamctl.plant.model import PlantSettings


class DiagnoseOptions(DataOptions):
    """`pamctl diagnose`."""

    out: Path | None = option(
        "--out DIR", "Folder for the results, new or empty",
        shown="required, except with --dry-run",
    )  # fmt: skip
    logs: list[Path] = argument(
        "LOG...",
        "Logs that the model is fitted to; with --on-rig they take the place of the first program",
        None,
        shown="required, except with --on-rig",
    )
    holdout: list[Path] = option(
        "--holdout LOG",
        "Log that is not fitted: it judges what is said, and shows the gap; can be repeated",
        shown="none",
    )
    map_path: Path | None = MAP
    without: list[str] = option(
        "--without EFFECT", "Effect not to ask; can be repeated", shown="none"
    )
    jobs: int | None = JOBS
    interactive: bool = INTERACTIVE
    on_rig: bool = flag(
        "--on-rig", "Let a running daemon run programs, each chosen to decide what is left"
    )
    experiment: str = option("--experiment NAME|FILE", "First program on the rig", "diagnosis")
    runs: int = option("--runs N", "Most programs on the rig", 4, low=1, high=20)
    minutes: float = option("--minutes M", "Most time on the rig", 5.0, low=0.3, high=120.0)
    dry_run: bool = flag("--dry-run", "Print the plan on the rig and stop")
    yes: bool = MAY_MOVE
    socket: Path | None = SOCKET


@verb
def diagnose(asked: DiagnoseOptions) -> None:
    """Find what the model lacks to explain the logs, say what is sure of it, and add it.

    DIR gets diagnosis.json, report.html and plant.yaml, and next-experiment.yaml where a program
    would decide between explanations. plant.yaml is for --plant of compare and a next diagnose;
    of what a law can move, of run and tune, too. The exit code is 0 for every verdict, and 65
    if the data cannot be used.
    """
    out = asked.out
    _require_one_kind(asked)
    if out is not None:
        require_empty_folder(out)
    elif not asked.dry_run:
        raise typer.BadParameter("name a folder for the results", param_hint="--out")
    plant = asked.read_plant()
    _require_known(asked.without)
    if asked.on_rig:
        require_linux()
        diagnose_on_rig(asked, plant)
        return
    assert out is not None  # only --dry-run, which is for --on-rig, goes without
    from pamctl.diagnose import diagnose as find_missing_effects
    from pamctl.diagnose import report_diagnosis
    from pamctl.diagnose.record import require_held_out
    from pamctl.diagnose.refuse import read_acceptances
    from pamctl.diagnose.report.diagnosis_page import write_diagnosis

    accepted = read_acceptances(asked.accept)
    require_held_out(asked.logs, asked.holdout)
    stated = asked.read_noise()
    records = read_records([*asked.logs, *asked.holdout], asked.map_path)
    train, held = records[: len(asked.logs)], records[len(asked.logs) :]
    if not held:
        tell("no --holdout: two stretches of each log are held out")
    diagnosis = find_missing_effects(
        train,
        held,
        plant,
        without=asked.without,
        accept=accepted,
        noise=stated,
        jobs=asked.jobs,
        progress=tell,
    )
    names = [path.name for path in (*asked.logs, *asked.holdout)]
    failure, end = None, ""
    try:
        written = write_diagnosis(diagnosis, out, names, records, interactive=asked.interactive)
        end = f"\n\n{out}: {', '.join(written)}"
    except NewFileError as error:
        failure = error
    print_report(report_diagnosis(diagnosis), as_json=asked.as_json, failure=failure, end=end)
    raise typer.Exit(ExitCode.BAD_DATA if diagnosis.reason else ExitCode.OK)


_FOR_RIG = ("experiment", "runs", "minutes", "dry_run", "yes", "socket")
_FOR_LOGS = ("holdout", "without", "accept", "noise", "jobs", "interactive")


def _require_one_kind(asked: DiagnoseOptions) -> None:
    """Refuse options that would have no effect, and a diagnosis of nothing."""
    for name in _FOR_LOGS if asked.on_rig else _FOR_RIG:
        if asked.is_typed(name):
            why = "has no effect with --on-rig" if asked.on_rig else "is for --on-rig; add it"
            raise typer.BadParameter(why, param_hint=f"--{name.replace('_', '-')}")
    if not asked.logs and not asked.on_rig:
        raise typer.BadParameter(
            "name at least one log, or give --on-rig and let a daemon make them",
            param_hint="LOG...",
        )


def _require_known(names: Sequence[str]) -> None:
    from pamctl.plant.catalogue import CATALOGUE

    for name in names:
        if name not in CATALOGUE:
            hint = hint_at_nearest(name, CATALOGUE)
            raise typer.BadParameter(
                f"there is no effect {name} in the catalogue{hint}", param_hint="--without"
            )


# --- on the rig -------------------------------------------------------------------------------


def diagnose_on_rig(asked: DiagnoseOptions, plant: PlantSettings) -> None:
    """Run the rounds on the daemon's rig; write and print what was found, however they end."""
    from pamctl.commissioning.bench import Terminal
    from pamctl.on_rig.decide_on_rig import Investigation, write_investigation
    from pamctl.on_rig.rig_plan import Budget, make_rig_plan
    from pamctl.session.daemon_rig import connect

    records = read_records(asked.logs, asked.map_path)
    with connect(asked.socket) as rig:
        first = None if records else asked.experiment
        budget = Budget(asked.runs, asked.minutes)
        plan = make_rig_plan(rig.settings(), plant, first, budget)
        if asked.dry_run:
            print_result(plan.as_dict(), plan.describe(), as_json=asked.as_json)
            return
        tell(plan.describe())
        if not asked.yes:
            Terminal().require_yes("May the rig be pressurised and move?")
        investigation = Investigation(plan, records)
        assert asked.out is not None
        try:
            code, reason = _run_rounds(rig, investigation)
        except Exception as error:  # a fault of the program: the document holds what was found
            investigation.stopped = f"the program failed: {type(error).__name__}: {error}"
            write_investigation(investigation, asked.out)
            raise
    _finish(investigation, asked, code, reason)


def _run_rounds(rig: Any, investigation: Any) -> tuple[ExitCode, str]:
    """Return how the rounds ended; the rig is left, stopped and safe, when this returns."""
    from pamctl.on_rig.decide_on_rig import decide_on_rig
    from pamctl.session.pamctl_error import PamctlError

    try:
        with (
            end_on_signals(),
            rig,
        ):  # a daemon that cannot be left well ends the rounds, and loses none of them
            decide_on_rig(rig, investigation, progress=tell)
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


def _finish(investigation: Any, asked: DiagnoseOptions, code: ExitCode, reason: str) -> None:
    """Write the folder and print the result; the document is there as far as it is."""
    from pamctl.diagnose import report_diagnosis
    from pamctl.on_rig.decide_on_rig import tell_rounds, write_investigation

    assert asked.out is not None
    found = investigation.diagnosis
    if found is None:
        raise Failed(code, f"{reason}; nothing was diagnosed yet")
    failure, end = None, ""
    try:
        end = f"\n\n{asked.out}: {', '.join(write_investigation(investigation, asked.out))}"
    except NewFileError as error:
        failure = error
    report = report_diagnosis(found)
    tell_rounds(report, investigation)
    report.document = {**report.document, "on_rig": investigation.as_dict()}
    print_report(report, as_json=asked.as_json, failure=failure, end=end)
    if reason:
        print_error(reason)
    raise typer.Exit(code)
