"""What verbs print: results as text, or as one JSON document."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pamctl.base.new_file import NewFileError
from pamctl.base.texts import escape_name, to_json
from pamctl.cli.failure import Failed

if TYPE_CHECKING:
    from pamctl.diagnose.record import Record
    from pamctl.log.importing.column_map import ImportMap
    from pamctl.report.report import Report
    from pamctl.settings.resolve import RunSettings

PAGE_BEGIN = "<"
"""An older page is replaced; a file that begins otherwise is something else."""


def print_json(document: object) -> None:
    """Print one JSON document; floats that are not finite are "nan", "inf" and "-inf"."""
    typer.echo(json.dumps(json.loads(to_json(document)), indent=2))


def print_run_settings(settings: RunSettings, *, as_json: bool) -> None:
    """Print resolved settings, for people as a file."""
    from pamctl.settings.resolve import settings_to_json, settings_to_yaml

    typer.echo(settings_to_json(settings) if as_json else settings_to_yaml(settings).rstrip())


def tell(line: str) -> None:
    """Print a line about the work on standard error."""
    typer.echo(line, err=True)


def warn(path: Path, doubts: Iterable[str]) -> None:
    """Print what is doubtful in a file on standard error."""
    for doubt in doubts:
        tell(f"warning: {escape_name(str(path))}: {doubt}")


def read_map(path: Path | None) -> ImportMap | None:
    """Read the file of `--map`, if there is one. Raise ConfigError with each wrong key."""
    if path is None:
        return None
    from pydantic import TypeAdapter

    from pamctl.log.importing.column_map import ImportMap
    from pamctl.settings.resolve import RawSettings, validate_settings

    return validate_settings(TypeAdapter(ImportMap), RawSettings.read(path))


def read_records(paths: Iterable[Path], map_path: Path | None = None) -> list[Record]:
    """Read logs and measured files; say on standard error what is doubtful in which of them."""
    from pamctl.diagnose.read_record import record_of
    from pamctl.diagnose.record import group_notes

    column_map = read_map(map_path)
    records = [record_of(path, column_map) for path in paths]
    for note in group_notes(records):
        tell(note)
    return records


class Saving:
    """A block that writes results. Why it could not is kept: the results are printed then."""

    failure: NewFileError | None = None

    def __enter__(self) -> Saving:
        """Return itself."""
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        """Keep a failure to write; every other error goes on."""
        if not isinstance(error, NewFileError):
            return False
        self.failure = error
        return True


def print_report(
    report: Report, *, as_json: bool, failure: NewFileError | None = None, end: str = ""
) -> None:
    """Print a report, and a line at its end; raise `Failed` if it could not be saved."""
    from pamctl.report.report import format_terminal

    text = "" if as_json else format_terminal(report) + end
    print_result(report.document, text, failure, as_json=as_json)


def print_result(
    document: object, text: str, failure: NewFileError | None = None, *, as_json: bool
) -> None:
    """Print a result; raise `Failed` if it could not be saved: it is not lost with the file."""
    if not as_json:
        typer.echo(text)
    elif failure is None:
        print_json(document)
    if failure is not None:
        kept = json.loads(to_json(document))
        details = {key: kept[key] for key in kept if key not in {"exit_code", "reason"}}
        raise Failed(failure.exit_code, str(failure), **details)
