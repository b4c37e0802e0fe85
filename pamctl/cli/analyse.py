"""The verbs that judge logs against code and model: report, replay, compare, health, reproduce."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pamctl.base.errors import ExitCode
from pamctl.base.new_file import require_empty_folder, require_folder, require_place, write_files
from pamctl.base.texts import to_json
from pamctl.cli.options import (
    CONTROLLER_FROM,
    INTERACTIVE,
    JOBS,
    MAP,
    NO_CHANGES,
    DataOptions,
    Options,
    argument,
    flag,
    option,
    verb,
)
from pamctl.cli.output import (
    PAGE_BEGIN,
    Saving,
    print_report,
    print_result,
    read_map,
    tell,
    warn,
)

if TYPE_CHECKING:
    from pamctl.log import Log


class ReportOptions(Options):
    """`pamctl report`."""

    paths: list[Path] = argument("LOG...", "Logs to report on")
    out: Path | None = option("--out FILE.html", "HTML page to write", shown="beside the first log")
    interactive: bool = INTERACTIVE


@verb
def report(asked: ReportOptions) -> None:
    """Write one self-contained HTML page with figures and plots of these logs."""
    from pamctl.log.reader import read_some
    from pamctl.report.html_page import write_html
    from pamctl.report.reported_run import REPORT_FIELDS
    from pamctl.report.run_page import compose_report, find_doubts

    logs = [read_some(path, REPORT_FIELDS) for path in asked.paths]
    doubts = [find_doubts(log) for log in logs]
    for path, found in zip(asked.paths, doubts, strict=True):
        warn(path, found)
    target = asked.out or asked.paths[0].with_suffix(".html")
    require_place(target, replaces=PAGE_BEGIN)
    html = write_html(compose_report(logs, doubts), interactive=asked.interactive)
    write_files({target: html}, replaces=PAGE_BEGIN)
    document = {"page": str(target), "bytes": len(html.encode()), "logs": asked.paths}
    print_result(document, f"report: {target}", as_json=asked.as_json)


# --- replay -----------------------------------------------------------------------------------

_OTHER_CPU = "default-for-other-cpu"


class ReplayOptions(Options):
    """`pamctl replay`."""

    path: Path = argument("LOG", "Log to replay")
    from_s: float | None = option(
        "--from SECONDS", "Start at the last frozen state before this time", low=0.0,
        shown="the beginning",
    )  # fmt: skip
    tolerance: str | None = option(
        f"--tolerance {_OTHER_CPU}", "Permit the rounding of another CPU or C library",
        shown="none, bit for bit",
    )  # fmt: skip
    plain: bool = flag("--plain", "Run the tick in plain Python, as the loop does")
    controller: str | None = option(
        "--controller NAME|FILE", "What-if: show what this control law would have commanded",
        shown="the log's own",
    )  # fmt: skip
    controller_from: str | None = CONTROLLER_FROM
    overrides: list[str] = option(
        "--set KEY=VALUE",
        "What-if: gain to change, such as controller.eta=0; can be repeated",
        shown=NO_CHANGES,
    )
    csv: Path | None = option(
        "--csv FILE", "What-if: new file with both commands, tick by tick", shown="no file"
    )


@verb
def replay(asked: ReplayOptions) -> None:
    """Run the tick over a log's raw samples, and compare every stage with the log.

    With --controller or --set it shows what other gains would have commanded.
    That is open loop: the muscle did not follow them.

    A log whose law is not installed ends with exit code 65, and names the package or the file.
    """
    is_what_if = asked.controller is not None or bool(asked.overrides)
    if asked.csv is not None and not is_what_if:
        message = "belongs to a what-if: with --controller or --set"
        raise typer.BadParameter(message, param_hint="--csv")
    if asked.tolerance is not None and is_what_if:
        message = "belongs to a comparison: without --controller and --set"
        raise typer.BadParameter(message, param_hint="--tolerance")
    if asked.tolerance not in (None, _OTHER_CPU):
        message = f"must be {_OTHER_CPU}; files of tolerances are gone"
        raise typer.BadParameter(message, param_hint="--tolerance")
    if asked.csv is not None:
        require_place(asked.csv)
    from pamctl.log.measured_signals import judge_description
    from pamctl.log.reader import read_paged
    from pamctl.settings.resolve import use_law_file

    if asked.controller_from is not None:
        use_law_file(asked.controller_from)
    log = read_paged(asked.path)
    warn(asked.path, judge_description(log))
    work = _run_what_if if is_what_if else _compare_with_log
    raise typer.Exit(work(log, asked))


def _compare_with_log(log: Log, asked: ReplayOptions) -> ExitCode:
    from pamctl.offline.tick_replay import EXACT, OTHER_CPU, replay_log
    from pamctl.report.replay_text import report_replay

    tolerances = EXACT if asked.tolerance is None else OTHER_CPU
    found = replay_log(log, from_s=asked.from_s, plain=asked.plain, tolerances=tolerances)
    print_report(report_replay(found, asked.tolerance), as_json=asked.as_json)
    return ExitCode.OK if found.is_equal else ExitCode.CHECK_FAILED


def _run_what_if(log: Log, asked: ReplayOptions) -> ExitCode:
    from pamctl.offline.replay_source import read_replay_source
    from pamctl.offline.what_if import replace_law, run_what_if
    from pamctl.report.replay_text import report_what_if

    settings = replace_law(read_replay_source(log).settings, asked.controller, asked.overrides)
    answer = run_what_if(log, settings, from_s=asked.from_s)
    with Saving() as saving:
        if asked.csv is not None:
            answer.write_csv(asked.csv)
    saved = None if asked.csv is None or saving.failure else str(asked.csv)
    found = report_what_if(log, settings, asked.controller or "the changed law", answer)
    found.document = {**found.document, "csv": saved}
    print_report(found, as_json=asked.as_json, failure=saving.failure)
    return ExitCode.OK


# --- compare ----------------------------------------------------------------------------------


class CompareOptions(Options):
    """`pamctl compare`."""

    paths: list[Path] = argument(
        "LOG...", "Logs, or measured files such as CSV, that the models are held to, one by one"
    )
    map_path: Path | None = MAP
    plants: list[str] = option(
        "--plant NAME|FILE", "Plant file with a model to compare; can be repeated",
        shown="the log's own, else paper",
    )  # fmt: skip
    plot: Path | None = option("--plot FILE", "HTML page with plots to write", shown="no page")
    interactive: bool = INTERACTIVE


@verb
def compare(asked: CompareOptions) -> None:
    """Drive models by the logged command, and compare them with the measurement."""
    plot = asked.plot
    if plot is not None and len(asked.paths) > 1:
        raise typer.BadParameter("a page is of one log; leave out the others", param_hint="--plot")
    if asked.interactive and plot is None:
        raise typer.BadParameter("there is no page; give --plot too", param_hint="--interactive")
    if plot is not None:
        require_place(plot, replaces=PAGE_BEGIN)
    from pamctl.diagnose.read_record import list_notes, open_as_log
    from pamctl.log.measured_signals import SIGNAL_FIELDS
    from pamctl.log.reader import read, read_some
    from pamctl.models.comparison import compare_plants
    from pamctl.models.comparison_report import report_comparison
    from pamctl.report.html_page import write_html
    from pamctl.report.progress_line import WorkProgress
    from pamctl.report.report import format_terminal

    reports, count = [], len(asked.paths)
    column_map = read_map(asked.map_path)
    with WorkProgress("compare") as progress:
        for number, path in enumerate(asked.paths):
            progress(number, count, f"reading {path.name}")
            with open_as_log(path, column_map) as (log_path, told):
                log = read_some(log_path, SIGNAL_FIELDS) if plot is None else read(log_path)
                log = replace(log, path=path)
            warn(path, () if told else list_notes(log))
            for note in told:
                tell(f"{path.stem}: {note}")

            def show_plant(done: float, of: float, doing: str, before: int = number) -> None:
                progress(before + done / of, count, doing)

            found = compare_plants(log, asked.plants, show_plant)
            reports.append(report_comparison(log, found, asked.map_path, is_drawn=plot is not None))
    if len(reports) > 1:
        documents = [{**one.document, "plot": None} for one in reports]
        text = "\n\n".join(map(format_terminal, reports))
        print_result(documents, text, as_json=asked.as_json)
        return
    (one,) = reports
    with Saving() as saving:
        if plot is not None:
            page = write_html(one, interactive=asked.interactive)
            write_files({plot: page}, replaces=PAGE_BEGIN)
    saved = None if plot is None or saving.failure else str(plot)
    one.document = {**one.document, "plot": saved}
    end = f"\nplots: {saved}" if saved else ""
    print_report(one, as_json=asked.as_json, failure=saving.failure, end=end)


# --- health -----------------------------------------------------------------------------------


class HealthOptions(DataOptions):
    """`pamctl health`."""

    folder: Path = argument("DIR", "Folder with the logs of one rig")
    out: Path = option("--out DIR", "Folder for the results, new or empty", ...)
    last: int | None = option("--last N", "Newest logs to fit", shown="all", low=2)
    jobs: int | None = JOBS


@verb
def health(asked: HealthOptions) -> None:
    """Fit the plant's numbers to every run of a folder, and say which of them drift.

    DIR of --out gets health.json, report.html and plant.yaml, the last good state.
    A number is compared with its 90 % intervals; steps and trends are told apart.
    """
    require_empty_folder(asked.out)
    plant = asked.read_plant()
    from pamctl.base.worker_processes import start_workers
    from pamctl.diagnose.refuse import read_acceptances
    from pamctl.report.html_page import write_html
    from pamctl.runs.run_index import RunIndex
    from pamctl.runs.run_row import UNREADABLE
    from pamctl.watch.follow_health import Stated, follow_health
    from pamctl.watch.health_words import format_good_plant, report_health

    stated = Stated(read_acceptances(asked.accept), asked.read_noise())
    folder = asked.folder
    index = RunIndex(folder)
    index.refresh()
    rows = [row for row in index.select() if row.ending != UNREADABLE]
    logs = [(folder / row.path, row.when_s) for row in rows][-asked.last if asked.last else 0 :]
    with start_workers(asked.jobs) if asked.jobs != 1 else nullcontext() as executor:
        found = follow_health(logs, plant, executor, tell, stated)
    report = report_health(found, folder.name or str(folder))
    files = {
        "health.json": to_json(report.document).decode() + "\n",
        "report.html": write_html(report),
    }
    if found.plant is not None:
        files["plant.yaml"] = format_good_plant(found)
    with Saving() as saving:
        write_files({asked.out / name: content for name, content in files.items()})
    end = f"\n\n{asked.out}: {', '.join(files)}"
    print_report(report, as_json=asked.as_json, failure=saving.failure, end=end)


# --- reproduce --------------------------------------------------------------------------------

_ALL = "all"
_NUMBERS_BEGIN = "{"


class ReproduceOptions(Options):
    """`pamctl reproduce`."""

    part: str = argument("fig3|fig4|fig5|table4|all", "Part of the paper")
    out: Path = option("--out DIR", "Folder for the page and the numbers", ...)
    seed: int = option("--seed N", "Seed of the simulated noise", 0, low=0)


@verb
def reproduce(asked: ReproduceOptions) -> None:
    """Write DIR/index.html and DIR/numbers.json; every number is simulated now."""
    from pamctl.models.reproduction import PARTS, reproduce_paper
    from pamctl.report.html_page import write_html
    from pamctl.report.progress_line import WorkProgress

    part, out = asked.part, asked.out
    if part not in (_ALL, *PARTS):
        known = ", ".join((*PARTS, _ALL))
        raise typer.BadParameter(f"{part}: unknown; there are {known}", param_hint="part")
    parts = list(PARTS) if part == _ALL else [part]
    page, numbers = out / "index.html", out / "numbers.json"
    require_folder(out)
    if out.is_dir():
        require_place(page, replaces=PAGE_BEGIN)
        require_place(numbers, replaces=_NUMBERS_BEGIN)
    with WorkProgress("reproduce") as progress:
        made = reproduce_paper(parts, asked.seed, progress)
    with Saving() as saving:
        write_files({page: write_html(made)}, replaces=PAGE_BEGIN)
        written = to_json(made.document).decode() + "\n"
        write_files({numbers: written}, replaces=_NUMBERS_BEGIN)
    end = "" if saving.failure else f"\n\npage: {page}\nnumbers: {numbers}"
    print_report(made, as_json=asked.as_json, failure=saving.failure, end=end)
