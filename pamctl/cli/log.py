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
    from pamctl.log.check.check_log import LogCheckReport
    from pamctl.log.repair.recover import Recovery

log_app = typer.Typer(no_args_is_help=True, help="Look into logs, mend, export and import them.")

LogArgument = Annotated[Path, typer.Argument(metavar="LOG")]


@contextmanager
def exit_on_log_errors(*, as_json: bool = False) -> Iterator[None]:
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

    with exit_on_log_errors(as_json=as_json):
        found = info(path)
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        if found["outcome"]:
            found["outcome"] = f"{found['outcome']['code']}: {found['outcome']['reason']}"
        typer.echo("\n".join(_format_info(found)))
    if not found["complete"]:
        way_out = f"save all that is whole with `pamctl log recover {path} DESTINATION`"
        typer.echo(f"error: {path} is damaged, or not finished: {way_out}", err=True)
        raise typer.Exit(ExitCode.CHECK_FAILED)


def _format_info(found: dict[str, Any]) -> list[str]:
    """Lay out what is known, a line each; what is not known is left out."""
    return [
        f"{name.replace('_', ' '):<16}{_format_value(value)}"
        for name, value in found.items()
        if value not in (None, {}, [])
    ]


def _format_value(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_format_value(part)}" for name, part in value.items())
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@log_app.command("check")
def check_logs(
    paths: Annotated[list[Path], typer.Argument(metavar="LOG...")], as_json: JsonOption = False
) -> None:
    """Check files, checksums, indexes, tick numbers, times, units and configuration.

    Exits with 3 if there is an error in any of them, 65 if a file is no log at all.
    """
    reports = [_check_log(path) for path in paths]
    if as_json:
        typer.echo(json.dumps([report for _, report in reports], indent=2))
    else:
        typer.echo("\n".join(line for _, report in reports for line in _format_report(report)))
    raise typer.Exit(max(code for code, _ in reports))


def _check_log(path: Path) -> tuple[ExitCode, dict[str, Any]]:
    from pamctl.log import LogError
    from pamctl.log.check.check_log import check_log

    try:
        report = check_log(path, _find_config_problems)
    except LogError as error:
        return ExitCode.BAD_DATA, {"path": str(path), "ok": False, "reason": str(error)}
    return ExitCode.OK if report.ok else ExitCode.CHECK_FAILED, _make_report(report)


def _make_report(report: LogCheckReport) -> dict[str, Any]:
    findings = [finding._asdict() for finding in report.findings]
    return {"path": report.path, "ok": report.ok, "ticks": report.ticks, "findings": findings}


def _find_config_problems(text: str) -> list[str]:
    """Say why a configuration in a log cannot be used by this version, if it cannot."""
    from pamctl.settings.problems import ConfigError
    from pamctl.settings.resolve import from_resolved

    try:
        from_resolved(text, "config.json")
    except ConfigError as error:
        return [str(problem) for problem in error.problems]
    return []


def _format_report(report: dict[str, Any]) -> list[str]:
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
    from pamctl.log.repair.recover import recover_file

    with exit_on_log_errors(as_json=as_json):
        recovery = recover_file(source, destination)
    if as_json:
        typer.echo(json.dumps(asdict(recovery), indent=2))
    else:
        typer.echo("\n".join(_format_recovery(recovery)))
    raise typer.Exit(ExitCode.OK if recovery.lossless else ExitCode.CHECK_FAILED)


def _format_recovery(recovery: Recovery) -> list[str]:
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
