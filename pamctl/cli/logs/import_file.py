"""`pamctl log import`: a log of what another system measured."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json
from pamctl.exit_codes import ExitCode

if TYPE_CHECKING:
    from pamctl.log.importing.column_map import ImportMap


def import_file(
    source: Annotated[
        Path,
        typer.Argument(metavar="IN", help="Measurement: text, MAT, TDMS, LVM, Excel, HDF5, NPZ"),
    ],
    destination: Annotated[Path, typer.Argument(metavar="OUT", help="New log")],
    map_path: Annotated[
        Path | None,
        typer.Option(
            "--map",
            metavar="FILE",
            help="File that says what the columns hold",
            show_default="by their names",
        ),
    ] = None,
    resample_hz: Annotated[
        float | None,
        typer.Option(
            "--resample",
            metavar="HZ",
            min=1e-3,
            help="Rate of an even time grid to resample to, Hz",
            show_default="not resampled",
        ),
    ] = None,
    accept_units: Annotated[
        bool, typer.Option("--accept-units", help="Import even if a unit looks wrong")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Import a measurement: time, valve command, pressure, position, force.

    A header says quantity and unit: position_mm, pressure_gauge_kpa, `Position [mm]`.
    Errors stop the import (65); warnings go into the log.
    """
    from pamctl.log.importing.pipeline import format_page, import_log

    done = import_log(
        source,
        destination,
        _read_map(map_path) if map_path else None,
        resample_hz=resample_hz,
        accept_units=accept_units,
    )
    if as_json:
        print_json({**asdict(done), "findings": [finding._asdict() for finding in done.findings]})
    else:
        head = f"{done.source}: not imported; {done.form}"
        if done.written:
            rate = f"one every {done.period_s:.6g} s, over {done.lasts_s:.6g} s"
            head = f"{done.destination}: {done.ticks} ticks, {rate}; {done.form}"
        page = format_page(head, done.columns, done.findings, done.map_text)
        typer.echo("\n".join(page))
    raise typer.Exit(ExitCode.OK if done.written else ExitCode.BAD_DATA)


def _read_map(path: Path) -> ImportMap:
    from pydantic import TypeAdapter

    from pamctl.log.importing.column_map import ImportMap
    from pamctl.settings.resolve import RawSettings, validate_settings

    return validate_settings(TypeAdapter(ImportMap), RawSettings.read(path))
