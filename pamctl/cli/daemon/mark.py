"""`pamctl mark`: put a remark into the log of the run that goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.daemon.ask import ask, print_answer
from pamctl.cli.failure import Failed
from pamctl.cli.options import JsonOption, SocketOption, require_linux
from pamctl.exit_codes import ExitCode
from pamctl.plain_text import LONGEST_REMARK, clean_text


def check_remark(text: str) -> str:
    """Return the remark without control characters; leave with 2 where it is empty or too long."""
    text = clean_text(text)
    if not 1 <= len(text) <= LONGEST_REMARK:
        message = f"must have 1 to {LONGEST_REMARK} characters (got {len(text)})"
        raise typer.BadParameter(message)
    return text


def mark(
    text: Annotated[
        str,
        typer.Argument(callback=check_remark, help="Remark of 1 to 2000 characters"),
    ],
    log: Annotated[
        Path | None,
        typer.Option(
            "--log",
            metavar="FILE",
            help="Log of the run to mark, where several go on",
            show_default="the only one",
        ),
    ] = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Put a remark into the log of the run that goes on, of the daemon or of pamctl run."""
    require_linux()
    from pamctl.processes.mark_desk import list_running_runs, mark_run

    runs = [] if socket is not None else list_running_runs()
    if log is not None:
        runs = [run for run in runs if run.log == log.absolute()]
    elif runs:
        choices = [str(run.log) for run in runs] + _find_daemon_log()
        if len(choices) > 1:
            raise typer.BadParameter(
                f"several runs go on; choose one with --log: {', '.join(choices)}",
                param_hint="--log",
            )
    if runs:
        mark_run(runs[0], text)
        print_answer({"log": str(runs[0].log)}, "marked", as_json=as_json)
        return
    if log is not None and _find_daemon_log(socket) != [str(log.absolute())]:
        raise Failed(ExitCode.CHECK_FAILED, f"no run that takes marks writes {log}")
    print_answer(ask(socket, "mark", {"text": text}), "marked", as_json=as_json)


def _find_daemon_log(socket: Path | None = None) -> list[str]:
    """Return the log that a daemon writes now; empty where there is none."""
    from pamctl.daemon.client import DaemonDeclinedError, DaemonUnreachableError

    try:
        log = ask(socket, "status")["log"]
    except (DaemonUnreachableError, DaemonDeclinedError):
        return []
    return [] if log is None else [log]
