"""`pamctl log check`: whether logs are whole and make sense."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json
from pamctl.exit_codes import ExitCode
from pamctl.plain_text import escape_name
from pamctl.settings.problems import ConfigError

if TYPE_CHECKING:
    from pamctl.log.check import LogCheckReport


def check_logs(
    paths: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs to check")],
    as_json: JsonOption = False,
) -> None:
    """Check files, checksums, indexes, tick numbers, times, signals, units and configuration.

    Exits with 3 if there is an error in any of them, 65 if a file is no log at all.
    """
    reports = [_check_log(path) for path in paths]
    if as_json:
        print_json([report for _, report in reports])
    else:
        typer.echo("\n".join(line for _, report in reports for line in _format_report(report)))
    raise typer.Exit(max(code for code, _ in reports))


def _check_log(path: Path) -> tuple[ExitCode, dict[str, Any]]:
    from pamctl.log import LogError
    from pamctl.log.check import check_log

    try:
        report = check_log(path, _find_config_problems)
    except LogError as error:
        return ExitCode.BAD_DATA, {"path": str(path), "ok": False, "reason": str(error)}
    return ExitCode.OK if report.ok else ExitCode.CHECK_FAILED, _make_report(report)


def _make_report(report: LogCheckReport) -> dict[str, Any]:
    findings = [finding._asdict() for finding in report.findings]
    return {"path": report.path, "ok": report.ok, "ticks": report.ticks, "findings": findings}


def _find_config_problems(text: str) -> list[str]:
    """Return why this version cannot use the configuration in a log; empty if it can."""
    from pamctl.settings.resolve import from_resolved

    try:
        from_resolved(text, "config.json")
    except ConfigError as error:
        return [str(problem) for problem in error.problems]
    return []


def _format_report(report: dict[str, Any]) -> list[str]:
    name = escape_name(report["path"])
    if "reason" in report:
        return [f"{name}: no log", f"  error    {report['reason']}"]
    verdict = f"{'ok' if report['ok'] else 'not ok'}, {report['ticks']} ticks"
    kinds = {f["kind"] for f in report["findings"] if f["severity"] == "error"}
    fixes = dict.fromkeys(fix for kind, fix in _FIXES.items() if kind in kinds)
    return [
        f"{name}: {verdict}",
        *(f"  {f['severity']:<9}{f['kind']:<12}{f['message']}" for f in report["findings"]),
        *(f"  way on   {fix.format(name)}" for fix in fixes),
    ]


_RECOVER = "save all that is whole: pamctl log recover {} NEW.mcap"
_CUT = "cut a sound part out: pamctl log cut {} --out PART.mcap --from-s ... --to-s ..."
_ANEW = "make a log of what was measured anew: pamctl log export {} T.csv, then log import"
_FIXES = {
    **dict.fromkeys(("damage", "index", "summary", "chunk", "order"), _RECOVER),
    **dict.fromkeys(("backwards", "duplicated", "phase", "empty", "missing"), _CUT),
    **dict.fromkeys(("tick-order", "clock", "gap", "sequence", "reversed", "columns"), _ANEW),
    "schema": "export the ticks for other tools: pamctl log export {} NEW.csv",
    "config": "replay it with the version that wrote it, which pamctl log info {} names",
}
"""What to do about errors, by their kind."""
