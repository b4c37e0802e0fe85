"""`pamctl replay`: does this code make the log's stages of the log's samples?"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.options import NO_CHANGES, ControllerFromOption, JsonOption
from pamctl.cli.output import print_json, print_result
from pamctl.exit_codes import ExitCode
from pamctl.new_file import NewFileError, require_place
from pamctl.plain_text import escape_name

if TYPE_CHECKING:
    from pamctl.log import Log


def replay(
    path: Annotated[Path, typer.Argument(metavar="LOG", help="Log to replay")],
    from_s: Annotated[
        float | None,
        typer.Option(
            "--from",
            metavar="SECONDS",
            help="Start at the last frozen state before this time, at least 0 s",
            show_default="the beginning",
        ),
    ] = None,
    tolerance: Annotated[
        str | None,
        typer.Option(
            "--tolerance",
            metavar="default-for-other-cpu",
            help="Permit the rounding of another CPU or C library",
            show_default="none, bit for bit",
        ),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="Run the tick in plain Python, as the loop does")
    ] = False,
    controller: Annotated[
        str | None,
        typer.Option(
            "--controller",
            metavar="NAME|FILE",
            help="What-if: show what this control law would have commanded",
            show_default="the log's own",
        ),
    ] = None,
    controller_from: ControllerFromOption = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="What-if: gain to change, such as controller.eta=0; can be repeated",
            show_default=NO_CHANGES,
        ),
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(
            "--csv",
            metavar="FILE",
            help="What-if: new file with both commands, tick by tick",
            show_default="no file",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the tick over a log's raw samples, and compare every stage with the log.

    With --controller or --set it shows what other gains would have commanded.
    That is open loop: the muscle did not follow them.

    A log whose law is not installed ends with exit code 65, and names the package or the file.
    """
    is_what_if = controller is not None or bool(overrides)
    if csv is not None and not is_what_if:
        message = "belongs to a what-if: with --controller or --set"
        raise typer.BadParameter(message, param_hint="--csv")
    if tolerance is not None and is_what_if:
        message = "belongs to a comparison: without --controller and --set"
        raise typer.BadParameter(message, param_hint="--tolerance")
    if tolerance not in (None, "default-for-other-cpu"):
        message = "must be default-for-other-cpu; files of tolerances are gone"
        raise typer.BadParameter(message, param_hint="--tolerance")
    if csv is not None:
        require_place(csv)
    if from_s is not None and not 0.0 <= from_s < math.inf:
        raise typer.BadParameter("must be seconds, 0 or more", param_hint="--from")
    from pamctl.log.measured_signals import judge_description
    from pamctl.log.reader import read_paged
    from pamctl.settings.resolve import use_law_file

    if controller_from is not None:
        use_law_file(controller_from)
    log = read_paged(path)
    for doubt in judge_description(log):
        typer.echo(f"warning: {escape_name(str(path))}: {doubt}", err=True)
    if is_what_if:
        code = _run_what_if(log, controller, overrides or [], from_s, csv, as_json=as_json)
    else:
        code = _compare_with_log(log, tolerance, from_s, plain=plain, as_json=as_json)
    raise typer.Exit(code)


def _compare_with_log(
    log: Log, tolerance: str | None, from_s: float | None, *, plain: bool, as_json: bool
) -> ExitCode:
    from pamctl.replay import replay_log
    from pamctl.replay.replay_text import format_replay, make_replay_document
    from pamctl.replay.tick_replay import EXACT, OTHER_CPU

    tolerances = EXACT if tolerance is None else OTHER_CPU
    found = replay_log(log, from_s=from_s, plain=plain, tolerances=tolerances)
    if as_json:
        print_json(make_replay_document(found, tolerance))
    else:
        typer.echo(format_replay(found))
    return ExitCode.OK if found.is_equal else ExitCode.CHECK_FAILED


def _run_what_if(
    log: Log,
    controller: str | None,
    overrides: list[str],
    from_s: float | None,
    csv: Path | None,
    *,
    as_json: bool,
) -> ExitCode:
    from pamctl.replay import read_replay_source
    from pamctl.replay.replay_text import format_what_if, make_what_if_document
    from pamctl.replay.what_if import replace_law, run_what_if

    settings = replace_law(read_replay_source(log).settings, controller, overrides)
    answer = run_what_if(log, settings, from_s=from_s)
    failure = None
    if csv is not None:
        try:
            answer.write_csv(csv)
        except NewFileError as error:
            failure = error
    saved = None if csv is None or failure else str(csv)
    print_result(
        {**make_what_if_document(log, settings, answer), "csv": saved},
        lambda: format_what_if(controller or "the changed law", answer),
        failure,
        as_json=as_json,
    )
    return ExitCode.OK
