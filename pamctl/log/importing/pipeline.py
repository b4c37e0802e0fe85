"""Import a measured file: read it, identify its columns, check them, write the log."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pamctl.json_text import to_json
from pamctl.log.check import LogFinding, LogFindings, Severity
from pamctl.log.importing.column_map import ImportMap
from pamctl.log.importing.csv_table import read_csv
from pamctl.log.importing.headers import match_headers
from pamctl.log.importing.imported_log import nominal_period_s, write_imported
from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable
from pamctl.log.importing.parse_apart import PARSERS, parse_apart
from pamctl.log.importing.plausibility import judge_sign, judge_time, judge_values
from pamctl.log.importing.quantities import TIME, ColumnReading
from pamctl.log.importing.resample import resample_columns
from pamctl.new_file import require_place
from pamctl.plain_text import escape_name
from pamctl.regular_file import describe_irregular_file

Floats = NDArray[np.float64]

_CLOSED = {
    ".xls": "the old format of Excel; save it as .xlsx or CSV",
    ".ods": "save the sheet as .xlsx or CSV",
    ".slx": "a model, not a measurement; save what it logged as a MAT file",
}
"""Formats that are often tried, with what to do."""
MOST_TICKS = 50_000_000
"""Half a day at 1 kHz: protects against a mistyped rate."""


@dataclass(frozen=True)
class ImportSummary:
    """The result of an import."""

    source: str
    destination: str
    written: bool
    """False if an error stopped the import: then no log was written."""
    ticks: int
    period_s: float | None
    """The nominal period: the median time step."""
    readings: tuple[ColumnReading, ...]
    findings: tuple[LogFinding, ...]


def import_log(
    source: str | Path,
    destination: str | Path,
    import_map: ImportMap | None = None,
    *,
    resample_hz: float | None = None,
    accept_units: bool = False,
) -> ImportSummary:
    """Make a log from a measured file, unless `findings` has an error.

    `accept_units` turns errors about implausible units into warnings. Raise ImportRefused if the
    file cannot be read or its columns cannot be identified, NewFileError if the log cannot be
    written.
    """
    source, destination = Path(source), Path(destination)
    require_place(destination)
    table = _read_table(source)
    findings = LogFindings()
    for note in table.notes:
        findings.warning("incomplete", note)
    readings = import_map.readings() if import_map else match_headers(table, findings)
    quantities = _convert_to_si(table, readings)
    t_s = quantities.pop(TIME, None)
    if t_s is None:
        t_s = _make_even_time(quantities, import_map)
    rows = table.rows[: len(t_s)]
    judge_time(t_s, rows, findings, _find_time_column(readings))
    judge_values(quantities, rows, findings)
    judge_sign(quantities, findings)
    _judge_whole(quantities, findings)
    if accept_units:
        findings.soften("unit")
    stopped = findings.any(Severity.ERROR)
    if not stopped:
        if resample_hz is not None:
            _note_resampling(t_s, resample_hz, findings)
            t_s, quantities = _resample_to_grid(t_s, quantities, resample_hz)
        story = _describe_import(source, table, readings, findings, float(t_s[0]), resample_hz)
        if import_map and import_map.valve and import_map.valve.acts_after_s:
            story["acts_after_s"] = repr(import_map.valve.acts_after_s)
        if import_map and (noise := import_map.stated_noise()):
            story["noise"] = to_json(noise).decode()
        write_imported(destination, t_s - t_s[0], quantities, story)
    return ImportSummary(
        source=str(source),
        destination=str(destination),
        written=not stopped,
        ticks=0 if stopped else len(t_s),
        period_s=None if stopped else nominal_period_s(t_s),
        readings=tuple(readings),
        findings=tuple(findings.summarise()),
    )


def _read_table(source: Path) -> MeasuredTable:
    if something := describe_irregular_file(source):
        raise ImportRefused(f"cannot read {source}: it is {something}")
    ending = source.suffix.lower()
    if ending in _CLOSED:
        raise ImportRefused(f"cannot read {source}: {_CLOSED[ending]}")
    if ending in PARSERS:
        return parse_apart(source)
    return read_csv(source)


def _convert_to_si(table: MeasuredTable, readings: Sequence[ColumnReading]) -> dict[str, Floats]:
    """Return the quantities in SI; all have the same length."""
    columns = {reading.quantity: _convert_one_to_si(table, reading) for reading in readings}
    lengths = {reading.column: len(table[reading.column]) for reading in readings}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ImportRefused(f"the columns differ in length: {listed}")
    return columns


def _convert_one_to_si(table: MeasuredTable, reading: ColumnReading) -> Floats:
    raw = table[reading.column]
    with np.errstate(over="ignore"):
        values = reading.to_si(raw)
    lost = np.flatnonzero(np.isfinite(raw) & ~np.isfinite(values))
    if len(lost):
        detail = f"{reading.column} is {raw[lost[0]]:g} {reading.unit} at row {table.rows[lost[0]]}"
        raise ImportRefused(f"{detail}: too large for a number in SI")
    return values


def _make_even_time(quantities: dict[str, Floats], import_map: ImportMap | None) -> Floats:
    rate_hz = import_map.time.rate_hz if import_map else None
    if rate_hz is None or not quantities:
        raise ImportRefused("no column of a measured quantity is named; there is nothing to import")
    return np.arange(len(next(iter(quantities.values())))) / rate_hz


def _find_time_column(readings: Sequence[ColumnReading]) -> str:
    return next((reading.column for reading in readings if reading.quantity == TIME), "rate_hz")


def _judge_whole(quantities: dict[str, Floats], findings: LogFindings) -> None:
    if not {"pressure_pa", "position_m"} & quantities.keys():
        findings.error("columns", "there is neither pressure nor position: nothing was measured")
    elif not quantities.keys() >= {"valve_v", "pressure_pa", "position_m"}:
        missing = {"valve_v", "pressure_pa", "position_m"} - quantities.keys()
        detail = f"no {', '.join(sorted(missing))}: only analyses that do not need it are possible"
        findings.warning("columns", detail)


def _resample_to_grid(
    t_s: Floats, quantities: dict[str, Floats], rate_hz: float
) -> tuple[Floats, dict[str, Floats]]:
    """Return the measurement at `rate_hz`; raise ImportRefused if fewer than two ticks remain."""
    grid_s, there = resample_columns(t_s, quantities, rate_hz)
    if len(grid_s) < 2:
        lasts_s, was_hz = t_s[-1] - t_s[0], 1.0 / nominal_period_s(t_s)
        detail = f"--resample {rate_hz:g} leaves 1 tick of {lasts_s:.6g} s"
        way_out = f"give a rate in Hz nearer to the measurement's own {was_hz:.6g}"
        raise ImportRefused(f"{detail}; a measurement needs at least two: {way_out}")
    return grid_s, there


def _note_resampling(t_s: Floats, rate_hz: float, findings: LogFindings) -> None:
    ticks = (t_s[-1] - t_s[0]) * rate_hz
    if ticks > MOST_TICKS:
        raise ImportRefused(f"--resample {rate_hz:g} would make {ticks:.3g} ticks: is it in Hz?")
    was_hz = 1.0 / nominal_period_s(t_s)
    findings.note(
        "resampled",
        f"from {was_hz:.6g} to {rate_hz:.6g} Hz; measured values interpolated, the command held",
    )
    if rate_hz < 0.9 * was_hz:
        detail = f"signals faster than {rate_hz / 2:.6g} Hz are aliased: there is no filter"
        findings.warning("aliasing", detail)


def _describe_import(
    source: Path,
    table: MeasuredTable,
    readings: Sequence[ColumnReading],
    findings: LogFindings,
    first_t_s: float,
    resample_hz: float | None,
) -> dict[str, str]:
    """Return the metadata record `import`: the source, and how the log was made from it."""
    return {
        "source": escape_name(source.name),
        "sha256": _hash_file(source),
        "rows": str(len(table.rows)),
        "first_t_s": repr(first_t_s),
        "map": to_json([asdict(reading) for reading in readings]).decode(),
        "resampled_hz": "" if resample_hz is None else repr(resample_hz),
        "report": to_json([finding._asdict() for finding in findings.summarise()]).decode(),
    }


def _hash_file(source: Path) -> str:
    with source.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
