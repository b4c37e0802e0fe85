"""`pamctl log`: what is in a log, whether it is whole, and what can be saved of one that is not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pamctl.cli.config import JsonOption
from pamctl.exit_codes import ExitCode

if TYPE_CHECKING:
    from pamctl.log.check.check_log import Report
    from pamctl.log.repair.recover import Recovery

log_app = typer.Typer(no_args_is_help=True, help="Look into logs, mend, export and import them.")

LogArgument = Annotated[Path, typer.Argument(metavar="LOG")]


@contextmanager
def log_errors_exit(*, as_json: bool = False) -> Iterator[None]:
    """Print what is wrong in one line; exit with 2 for the file to be written, 65 for a log."""
    from pamctl.log.framing import LogError
    from pamctl.log.new_file import NewFileError

    try:
        yield
    except LogError as error:
        code = ExitCode.USAGE if isinstance(error, NewFileError) else ExitCode.BAD_DATA
        if as_json:
            typer.echo(json.dumps({"exit_code": int(code), "reason": str(error)}, indent=2))
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(code) from None


@log_app.command("info")
def show_info(path: LogArgument, as_json: JsonOption = False) -> None:
    """Say what a log holds: run, ticks, gaps, phases, channels, outcome.

    Of a damaged or unfinished log it says what stands before the damage, and exits with 3.
    """
    from pamctl.log import info

    with log_errors_exit(as_json=as_json):
        found = info(path)
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        if found["outcome"]:
            found["outcome"] = f"{found['outcome']['code']}: {found['outcome']['reason']}"
        typer.echo("\n".join(_lines(found)))
    if not found["complete"]:
        way_out = f"save all that is whole with `pamctl log recover {path} DESTINATION`"
        typer.echo(f"error: {path} is damaged, or not finished: {way_out}", err=True)
        raise typer.Exit(ExitCode.CHECK_FAILED)


def _lines(found: dict[str, Any]) -> list[str]:
    """Lay out what is known, a line each; what is not known is left out."""
    return [
        f"{name.replace('_', ' '):<16}{_shown(value)}"
        for name, value in found.items()
        if value not in (None, {}, [])
    ]


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(part)}" for name, part in value.items())
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@log_app.command("check")
def check_logs(
    paths: Annotated[list[Path], typer.Argument(metavar="LOG...")], as_json: JsonOption = False
) -> None:
    """Check files, checksums, indexes, tick numbers, times, units and configuration.

    Exits with 3 if there is an error in any of them, 65 if a file is no log at all.
    """
    reports = [_checked(path) for path in paths]
    if as_json:
        typer.echo(json.dumps([report for _, report in reports], indent=2))
    else:
        typer.echo("\n".join(line for _, report in reports for line in _report_lines(report)))
    raise typer.Exit(max(code for code, _ in reports))


def _checked(path: Path) -> tuple[ExitCode, dict[str, Any]]:
    from pamctl.log import LogError
    from pamctl.log.check.check_log import check

    try:
        report = check(path, _problems_of_config)
    except LogError as error:
        return ExitCode.BAD_DATA, {"path": str(path), "ok": False, "reason": str(error)}
    return ExitCode.OK if report.ok else ExitCode.CHECK_FAILED, _report(report)


def _report(report: Report) -> dict[str, Any]:
    findings = [finding._asdict() for finding in report.findings]
    return {"path": report.path, "ok": report.ok, "ticks": report.ticks, "findings": findings}


def _problems_of_config(text: str) -> list[str]:
    """Say why a configuration in a log cannot be used by this version, if it cannot."""
    from pamctl.settings.problems import ConfigError
    from pamctl.settings.resolve import from_resolved

    try:
        from_resolved(text, "config.json")
    except ConfigError as error:
        return [str(problem) for problem in error.problems]
    return []


def _report_lines(report: dict[str, Any]) -> list[str]:
    if "reason" in report:
        return [f"{report['path']}: no log", f"  error    {report['reason']}"]
    verdict = f"{'ok' if report['ok'] else 'not ok'}, {report['ticks']} ticks"
    return [
        f"{report['path']}: {verdict}",
        *(f"  {f['severity']:<9}{f['kind']:<12}{f['message']}" for f in report["findings"]),
    ]


@log_app.command("recover")
def recover_log(
    source: Annotated[Path, typer.Argument(metavar="IN")],
    destination: Annotated[Path, typer.Argument(metavar="OUT")],
    as_json: JsonOption = False,
) -> None:
    """Save all that is whole of a damaged log into a new file; exits with 3 if anything is lost."""
    from pamctl.log.repair.recover import recover

    with log_errors_exit(as_json=as_json):
        recovery = recover(source, destination)
    if as_json:
        typer.echo(json.dumps(asdict(recovery), indent=2))
    else:
        typer.echo("\n".join(_recovery_lines(recovery)))
    raise typer.Exit(ExitCode.OK if recovery.lossless else ExitCode.CHECK_FAILED)


def _recovery_lines(recovery: Recovery) -> list[str]:
    saved = ", ".join(f"{count} of {topic}" for topic, count in recovery.messages.items())
    lines = [f"{recovery.destination}: saved {saved}"]
    lines += [f"  damage   {what}" for what in recovery.damage]
    if not recovery.lossless:
        lines.append(f"  lost     {recovery.bytes_lost} bytes that nothing could be made of")
    if recovery.unverified:
        lines.append(
            f"  doubtful no checksum vouches for the metadata {', '.join(recovery.unverified)}"
        )
    return lines
