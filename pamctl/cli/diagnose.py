"""`pamctl diagnose`, what the model lacks; `pamctl audit`, what an excitation cannot show.

On the rig `diagnose` asks before the first motion, runs the rounds, and keeps what was found.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from pamctl.base.errors import ExitCode, end_on_signals, name_interrupt
from pamctl.base.new_file import require_empty_folder
from pamctl.base.texts import count_of, hint_at_nearest
from pamctl.cli.failure import Failed, print_error
from pamctl.cli.options import (
    INTERACTIVE,
    JOBS,
    MAP,
    MAY_MOVE,
    SOCKET,
    DataOptions,
    PlantOptions,
    argument,
    flag,
    option,
    require_linux,
    verb,
)
from pamctl.cli.output import Saving, print_report, print_result, read_records, tell
from pamctl.cli.settings_from_options import find_argument_file

if TYPE_CHECKING:
    from pamctl.diagnose import Record
    from pamctl.diagnose.audit import Audit
    from pamctl.plant.model import PlantSettings
    from pamctl.report.report import Report


REFUSED_FILES = {"diagnosis.json", "report.html"}
"""What a diagnosis writes of data that it refuses."""


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
        "--without EFFECT",
        "Effect not to ask, or law without a name, such as 'curve of force over time', or all "
        "laws of force; can be repeated",
        shown="none",
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
    if the data cannot be used. Ctrl-C keeps what was found so far.
    """
    out = asked.out
    _require_one_kind(asked)
    if out is not None:
        if asked.on_rig or not _holds_refused(out):
            require_empty_folder(out)
    elif not asked.dry_run:
        raise typer.BadParameter("name a folder for the results", param_hint="--out")
    plant = asked.read_plant()
    without = [name for word in asked.without for name in _find_left_out(word, plant)]
    if asked.on_rig:
        require_linux()
        diagnose_on_rig(asked, plant)
        return
    assert out is not None  # only --dry-run, which is for --on-rig, goes without
    from pamctl.diagnose import DiagnosisInterrupted, report_diagnosis
    from pamctl.diagnose import diagnose as find_missing_effects
    from pamctl.diagnose.read_record import require_different_runs
    from pamctl.diagnose.refuse import read_acceptances
    from pamctl.diagnose.report.diagnosis_page import write_diagnosis

    accepted = read_acceptances(asked.accept)
    require_different_runs(asked.logs, asked.holdout)
    stated = asked.read_noise()
    records = read_records([*asked.logs, *asked.holdout], asked.map_path)
    train, held = records[: len(asked.logs)], records[len(asked.logs) :]
    if asked.plant is None:
        tell("no --plant: the start model is the paper's muscle and valve")
    if not held:
        tell("no --holdout: two stretches of each log are held out")
    code = ExitCode.OK
    try:
        with end_on_signals():
            diagnosis = find_missing_effects(
                train,
                held,
                plant,
                without=without,
                accept=accepted,
                noise=stated,
                jobs=asked.jobs,
                progress=tell,
            )
    except DiagnosisInterrupted as interrupted:
        diagnosis, code = interrupted.diagnosis, name_interrupt(interrupted)
    except KeyboardInterrupt as interrupt:
        raise Failed(name_interrupt(interrupt), "interrupted; nothing is kept") from None
    names = [path.name for path in (*asked.logs, *asked.holdout)]
    end = ""
    with Saving() as saving:
        for left in list(out.iterdir()) if _holds_refused(out) else ():
            left.unlink()  # the same command was typed again, with what it lacked
        written = write_diagnosis(diagnosis, out, names, records, interactive=asked.interactive)
        end = f"\n\n{out}: {', '.join(written)}"
    said = report_diagnosis(diagnosis)
    print_report(said, as_json=asked.as_json, failure=saving.failure, end=end)
    raise typer.Exit(ExitCode.BAD_DATA if diagnosis.reason else code)


def _holds_refused(out: Path) -> bool:
    """Tell whether a folder holds no more than what a run left that refused its data."""
    document = out / "diagnosis.json"
    if not document.is_file() or {path.name for path in out.iterdir()} - REFUSED_FILES:
        return False
    with suppress(OSError, ValueError, AttributeError):
        return bool(json.loads(document.read_text()).get("verdict") == "bad_data")
    return False


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


def _find_left_out(word: str, plant: PlantSettings) -> list[str]:
    """Return the hypotheses that a word names: an effect, or laws as a verdict has them."""
    from pamctl.diagnose.report.finding_words import call_hypotheses

    called = call_hypotheses(plant.actuator)
    if word not in called:
        raise typer.BadParameter(
            f"there is no effect or law {word}{hint_at_nearest(word, called)}; what can be left "
            "out are effects, laws as a verdict has them ('curve of force over time'), and all "
            "laws without a name of a place such as force",
            param_hint="--without",
        )
    return called[word]


# --- on the rig -------------------------------------------------------------------------------


def diagnose_on_rig(asked: DiagnoseOptions, plant: PlantSettings) -> None:
    """Run the rounds on the daemon's rig; write and print what was found, however they end."""
    from pamctl.commissioning.bench import Terminal
    from pamctl.session.daemon_rig import connect
    from pamctl.session.decide_on_rig import Investigation, write_investigation
    from pamctl.session.rig_plan import Budget, make_rig_plan

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
    from pamctl.session.decide_on_rig import decide_on_rig
    from pamctl.session.pamctl_error import PamctlError

    try:
        with (
            end_on_signals(),
            rig,
        ):  # a daemon that cannot be left well ends the rounds, and loses none of them
            decide_on_rig(rig, investigation, progress=tell)
    except KeyboardInterrupt as interrupt:
        investigation.stopped = "it was interrupted"
        return name_interrupt(interrupt), "interrupted"
    except PamctlError as error:
        investigation.stopped = f"the run failed: {error.reason}"
        return error.exit_code, error.reason
    bad = investigation.diagnosis is not None and investigation.diagnosis.reason
    return (ExitCode.BAD_DATA if bad else ExitCode.OK), ""


def _finish(investigation: Any, asked: DiagnoseOptions, code: ExitCode, reason: str) -> None:
    """Write the folder and print the result; the document is there as far as it is."""
    from pamctl.diagnose import report_diagnosis
    from pamctl.session.decide_on_rig import tell_rounds, write_investigation

    assert asked.out is not None
    found = investigation.diagnosis
    if found is None:
        raise Failed(code, f"{reason}; nothing was diagnosed yet")
    end = ""
    with Saving() as saving:
        end = f"\n\n{asked.out}: {', '.join(write_investigation(investigation, asked.out))}"
    report = report_diagnosis(found)
    tell_rounds(report, investigation)
    report.document = {**report.document, "on_rig": investigation.as_dict()}
    print_report(report, as_json=asked.as_json, failure=saving.failure, end=end)
    if reason:
        print_error(reason)
    raise typer.Exit(code)


# --- audit ------------------------------------------------------------------------------------


class AuditOptions(PlantOptions):
    """`pamctl audit`."""

    what: str = argument(
        "EXPERIMENT|LOG",
        "Name of an experiment, experiment file (.yaml), or log as `pamctl diagnose` reads it",
    )
    map_path: Path | None = MAP
    verbose: bool = flag("--verbose", "Say why each effect cannot be shown")


@verb
def audit(asked: AuditOptions) -> None:
    """Show which effects an experiment or a log cannot show, before anything is fitted.

    An experiment is simulated with the default controller and the simulated rig's sensors.
    """
    plant = asked.read_plant()
    from pamctl.diagnose.audit import audit_run
    from pamctl.diagnose.report.next_experiment import write_advice

    record = _make_record(asked)
    found = audit_run(record, plant)
    runs_here = plant.actuator == "muscle" and not record.is_imported
    has_pressure = record.pressure_pa is not None
    advise = partial(write_advice, plant=plant, runs_here=runs_here, has_pressure=has_pressure)
    print_report(report_audit(found, advise, verbose=asked.verbose), as_json=asked.as_json)


def _make_record(asked: AuditOptions) -> Record:
    """Read a log or a measured file; simulate an experiment, which is a name or a YAML file."""
    what, path = asked.what, Path(asked.what)
    if (
        asked.map_path
        or path.suffix == ".mcap"
        or (path.is_file() and path.suffix not in (".yaml", ".yml"))
    ):
        return read_records([path], asked.map_path)[0]
    find_argument_file("experiment", what)  # its error names what the user typed
    from pamctl.diagnose import Record
    from pamctl.offline.closed_loop import simulate_run
    from pamctl.settings.resolve import resolve

    run = simulate_run(resolve(experiment=what, plant=asked.plant))
    return Record(
        Path(what).stem,
        run.t_s,
        valve_v=run["valve_v"],
        pressure_pa=run["pressure_pa"],
        position_m=run["position_m"],
        experiment=what,
    )


def report_audit(found: Audit, advise: Callable[[str], str], *, verbose: bool) -> Report:
    """Return what an excitation shows and does not; with the reasons if `verbose`."""
    from pamctl.report.report import Points, Report, Section, Text

    spots = [(s.name, s.visibility, s.why, s.experiment) for s in found.blind_spots]
    pairs = [(" and ".join(p.names), "", p.why, p.experiment) for p in found.inseparable]
    unasked = [(name, "", why, "") for name, why in found.unasked]
    shows = f"shows {count_of(len(found.sees), 'effect')}"
    report = Report("Audit", shows, document=found.as_dict())
    report.add(Points([", ".join(found.sees)] if found.sees else []))
    report.add(*[Text("no blind spots")] * (not spots))
    adds: dict[str, list[str]] = {}
    for heading, rows in (
        ("cannot show, at the smallest size of interest", spots),
        ("cannot tell apart, at that size", pairs),
        (f"does not ask {count_of(len(unasked), 'effect')}", unasked),
    ):
        items = [": ".join(filter(None, row[: 3 if verbose else 2])) for row in rows]
        if rows and not any(said for _, said, *_ in rows) and not verbose:
            items = [", ".join(items)]
        if rows:
            report.add(Section(heading), Points(items))
        for name, _, _, experiment in rows:
            adds.setdefault(advise(experiment) if experiment else "", []).append(name)
    advice = [f"add: {what}  # for {', '.join(adds[what])}" for what in sorted(adds) if what]
    if found.is_covered:
        way_on = "first let `pamctl diagnose` find what is missing, then audit with its plant.yaml"
        report.add(Section("what the plant leaves unexplained hides effects"), Points([way_on]))
    if advice:
        report.add(Section("experiments that do"), Points(advice))
    if not verbose and (spots or unasked):
        report.add(Section("--verbose says why."), Text(""))
    return report
