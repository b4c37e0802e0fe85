"""`pamctl log`: look into logs, check, recover, cut, export and import them; on every system."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from pamctl.base.errors import ConfigError, ExitCode, Problem
from pamctl.base.texts import count_of, escape_name
from pamctl.cli.failure import print_error
from pamctl.cli.options import MAP, Options, argument, flag, option, verb
from pamctl.cli.output import print_report, print_result, read_map

if TYPE_CHECKING:
    from pamctl.log.importing.pipeline import ImportedColumn, ImportSummary
    from pamctl.report.report import Report

log_app = typer.Typer(
    no_args_is_help=True, help="Look into logs, mend, cut, export and import them."
)

# --- info -------------------------------------------------------------------------------------


class InfoOptions(Options):
    """`pamctl log info`."""

    path: Path = argument("LOG", "Log to look into")


@log_app.command("info")
@verb
def show_info(asked: InfoOptions) -> None:
    """Show what a log holds: run, ticks, gaps, phases, channels, outcome.

    Of a damaged or unfinished log it shows what stands before the damage, and exits with 3.
    """
    from pamctl.log import info
    from pamctl.log.run_meta import CHANGES, spell_controller
    from pamctl.report.report import Facts, Report

    found = info(asked.path)
    shown = {**found, "outcome": None}
    if found["outcome"]:
        shown["outcome"] = f"{found['outcome']['code']}: {found['outcome']['reason']}"
    if str(found["start"]).startswith("1970-01-01"):
        shown["start"] = "none (simulated without a clock)"
    shown["controller"] = spell_controller(found) or None
    facts = {
        name.replace("_", " "): _format_value(value)
        for name, value in shown.items()
        if name not in {"path", CHANGES} and value not in (None, {}, [], "")
    }
    report = Report("Log", escape_name(found["path"]), document=found)
    print_report(report.add(Facts(facts)), as_json=asked.as_json)
    if not found["complete"]:
        fix = f"save all that is whole with `pamctl log recover {asked.path} DESTINATION`"
        print_error(f"{asked.path} is damaged, or not finished: {fix}")
        raise typer.Exit(ExitCode.CHECK_FAILED)


def _format_value(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_format_value(part)}" for name, part in value.items())
    if isinstance(value, list):
        return " ".join(map(str, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# --- check ------------------------------------------------------------------------------------


class LogCheckOptions(Options):
    """`pamctl log check`."""

    paths: list[Path] = argument("LOG...", "Logs to check")


@log_app.command("check")
@verb
def check_logs(asked: LogCheckOptions) -> None:
    """Check files, checksums, tick numbers, times, signals, units and configuration.

    Exits with 3 if there is an error in any of them, 65 if a file is no log at all.
    """
    from pamctl.report.report import format_terminal

    checked = [_check_log(path) for path in asked.paths]
    documents = [report.document for _, report in checked]
    text = "\n".join(format_terminal(report) for _, report in checked)
    print_result(documents, text, as_json=asked.as_json)
    raise typer.Exit(max(code for code, _ in checked))


def _check_log(path: Path) -> tuple[ExitCode, Report]:
    from pamctl.log import LogError
    from pamctl.log.check import check_log, list_findings
    from pamctl.report.report import Problems, Report

    name = escape_name(str(path))
    try:
        checked = check_log(path, _find_config_problems)
    except LogError as error:
        document = {"path": str(path), "ok": False, "reason": str(error)}
        problem = Problem(name, "", str(error), fix=_NO_LOG)
        report = Report(f"{name}: no log", document=document)
        return ExitCode.BAD_DATA, report.add(Problems([problem]))
    document = {
        "path": checked.path,
        "ok": checked.ok,
        "ticks": checked.ticks,
        "findings": list_findings(checked.findings),
    }
    verdict = f"{name}: {'ok' if checked.ok else 'not ok'}, {count_of(checked.ticks, 'tick')}"
    report = Report(verdict, document=document)
    if checked.findings:
        report.add(Problems(checked.findings))
    return ExitCode.OK if checked.ok else ExitCode.CHECK_FAILED, report


def _find_config_problems(text: str) -> list[str]:
    """Return why this version cannot use the configuration in a log; empty if it can."""
    from pamctl.settings.resolve import from_resolved

    try:
        from_resolved(text, "config.json")
    except ConfigError as error:
        return [str(problem) for problem in error.problems]
    return []


_NO_LOG = "import a measured file by pamctl log import FILE NEW.mcap"

# --- recover ----------------------------------------------------------------------------------


class RecoverOptions(Options):
    """`pamctl log recover`."""

    source: Path = argument("IN", "Damaged log")
    destination: Path = argument("OUT", "New log")


@log_app.command("recover")
@verb
def recover_log(asked: RecoverOptions) -> None:
    """Save all that is whole of a damaged log into a new file; exits with 3 if anything is lost."""
    from pamctl.log.recover import recover_file

    recovery = recover_file(asked.source, asked.destination)
    saved = ", ".join(f"{count} of {topic}" for topic, count in recovery.messages.items())
    lines = [f"{escape_name(recovery.destination)}: saved {saved}"]
    lines += [f"  damage   {what}" for what in recovery.damage]
    if not recovery.lossless:
        lines.append(f"  lost     {recovery.bytes_lost} bytes that nothing could be made of")
    if recovery.unverified:
        lines.append(
            f"  doubtful no checksum vouches for the metadata {', '.join(recovery.unverified)}"
        )
    print_result(asdict(recovery), "\n".join(lines), as_json=asked.as_json)
    raise typer.Exit(ExitCode.OK if recovery.lossless else ExitCode.CHECK_FAILED)


# --- export -----------------------------------------------------------------------------------


class ExportOptions(Options):
    """`pamctl log export`."""

    source: Path = argument("LOG", "Log to export")
    destination: Path = argument("OUT", "New file: .csv, .mat or .parquet")
    fields: str | None = option(
        "--fields NAME,...", "Columns to export, in this order", shown="all columns"
    )
    from_s: float | None = option(
        "--from SECONDS", "First time to export, by t_s", shown="the beginning"
    )
    to_s: float | None = option("--to SECONDS", "Last time to export, by t_s", shown="the end")
    every: int = option("--every N", "Export every N-th tick, unfiltered", 1, low=1)


@log_app.command("export")
@verb
def export_log(asked: ExportOptions) -> None:
    """Write the ticks for other tools; names carry the units, floats are exact."""
    from pamctl.log.export import export_ticks

    names = None
    if asked.fields is not None:
        names = [name.strip() for name in asked.fields.split(",") if name.strip()]
        if not names:
            raise typer.BadParameter(f"{asked.fields!r} names no column", param_hint="--fields")
    done = export_ticks(
        asked.source,
        asked.destination,
        fields=names,
        from_s=asked.from_s,
        to_s=asked.to_s,
        every=asked.every,
    )
    size = f"{count_of(done.ticks, 'tick')}, {count_of(len(done.fields), 'column')}"
    print_result(asdict(done), f"{escape_name(done.destination)}: {size}", as_json=asked.as_json)


# --- cut --------------------------------------------------------------------------------------

_WHOLE = "the whole log"


class CutOptions(Options):
    """`pamctl log cut`."""

    source: Path = argument("LOG", "Log to cut")
    destination: Path = option(
        "--out NEW.mcap", "New log; with --at-gaps NEW-1.mcap, NEW-2.mcap and so on", ...
    )
    from_s: float | None = option("--from-s SECONDS", "First time, by t_s", low=0.0, shown=_WHOLE)
    to_s: float | None = option(
        "--to-s SECONDS", "End by t_s, itself not included", low=0.0, shown=_WHOLE
    )
    from_row: int | None = option("--from-row ROW", "First row, from 0", low=0, shown=_WHOLE)
    to_row: int | None = option("--to-row ROW", "End, itself not included", low=0, shown=_WHOLE)
    at_gaps: bool = flag("--at-gaps", "Write a file for each stretch between gaps")


@log_app.command("cut")
@verb
def cut_file(asked: CutOptions) -> None:
    """Write a piece of a log as a new log, by time, by rows, or a file for each stretch.

    Ticks keep their numbers and times. The new log names the log that it was cut from.
    """
    limits = {
        "from_s": asked.from_s,
        "to_s": asked.to_s,
        "from_row": asked.from_row,
        "to_row": asked.to_row,
    }
    if not asked.at_gaps and all(limit is None for limit in limits.values()):
        raise typer.BadParameter(
            "say what to cut: --from-s, --to-s, --from-row, --to-row or --at-gaps",
            param_hint="--out",
        )
    from pamctl.log.edit import cut_log

    given: Any = limits
    done = cut_log(asked.source, asked.destination, **given, at_gaps=asked.at_gaps)
    lines = [
        f"{escape_name(piece.destination)}: "
        f"{count_of(piece.last_row - piece.first_row + 1, 'row')}, {piece.first_row} to "
        f"{piece.last_row} of {done.rows}, {piece.from_s:.6g} to {piece.to_s:.6g} s"
        for piece in done.pieces
    ]
    if done.left_out:
        rows = ", ".join(map(str, done.left_out[:10]))
        lines.append(f"left out, alone between two gaps: row {rows}")
    print_result(asdict(done), "\n".join(lines), as_json=asked.as_json)


# --- import -----------------------------------------------------------------------------------


class ImportOptions(Options):
    """`pamctl log import`."""

    source: Path = argument("IN", "Measurement: text, MAT, TDMS, LVM, Excel, HDF5, NPZ")
    destination: Path = argument("OUT", "New log")
    map_path: Path | None = MAP
    resample_hz: float | None = option(
        "--resample HZ", "Rate of an even time grid to resample to, Hz", shown="not resampled",
        low=1e-3,
    )  # fmt: skip
    accept_units: bool = flag("--accept-units", "Import even if a unit looks wrong")


@log_app.command("import")
@verb
def import_file(asked: ImportOptions) -> None:
    """Import a measurement: time, valve command, pressure, position, force.

    A header says quantity and unit: position_mm, pressure_gauge_kpa, `Position [mm]`.
    Errors stop the import (65); warnings go into the log.
    """
    from pamctl.log.importing.pipeline import import_log

    done = import_log(
        asked.source,
        asked.destination,
        read_map(asked.map_path),
        resample_hz=asked.resample_hz,
        accept_units=asked.accept_units,
    )
    # As it is to be written: a report would spell it in ASCII.
    end = f"\nWith --map FILE, which may say:\n{done.map_text.rstrip()}" if done.map_text else ""
    print_report(_report_import(done), as_json=asked.as_json, end=end)
    raise typer.Exit(ExitCode.OK if done.written else ExitCode.BAD_DATA)


def _report_import(done: ImportSummary) -> Report:
    from pamctl.log.check import list_findings
    from pamctl.report.report import Problems, Report, ReportTable

    findings = list_findings(done.findings)
    head = f"{done.source}: not imported; {done.form}"
    if done.written:
        rate = f"one every {done.period_s:.6g} s, over {done.lasts_s:.6g} s"
        head = f"{done.destination}: {count_of(done.ticks, 'tick')}, {rate}; {done.form}"
    report = Report("Import", head, document={**asdict(done), "findings": findings})
    rows = [[str(c.number), c.name, *_describe_column(c)] for c in done.columns]
    report.add(ReportTable(["", "column", "read as", "", "from .. to"], rows))
    if done.findings:
        report.add(Problems(done.findings))
    return report


def _describe_column(column: ImportedColumn) -> tuple[str, str, str]:
    """Return how a column is read, its course, and between which values."""
    if column.left_out:
        return "left out", "", column.left_out
    ends = "no values"
    if column.lowest is not None and column.highest is not None:
        ends = f"{column.lowest:.6g} .. {column.highest:.6g}"
    rests = f", rests {column.rests:.0%}" if column.rests else ""
    gone = f", {column.missing} missing" if column.missing else ""
    return column.read_as, column.plot, f"{ends}{rests}{gone}"
