"""Import a measured file: read it, choose its columns, check them, write the log, answer a page."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from pamctl.json_text import to_json
from pamctl.log.check import LogFinding, LogFindings, Severity
from pamctl.log.importing.column_map import ImportMap
from pamctl.log.importing.column_roles import (
    ChosenColumns,
    choose_by_header,
    show_map,
    understand_column,
    write_map_line,
)
from pamctl.log.importing.file_formats import read_table
from pamctl.log.importing.import_page import ImportedColumn, describe_column
from pamctl.log.importing.imported_log import write_imported
from pamctl.log.importing.measured_table import Floats, ImportRefused, Ints, MeasuredTable
from pamctl.log.importing.plausibility import judge_clock, judge_record, judge_units
from pamctl.log.importing.quantities import ATMOSPHERIC_PRESSURE_PA, TIME, ColumnReading, TextHints
from pamctl.log.record_problems import GAP_PERIODS, nominal_period_s
from pamctl.new_file import require_place
from pamctl.plain_text import escape_name

MOST_TICKS = 50_000_000
"""Half a day at 1 kHz: protects against a mistyped rate."""
_MISSED = {"valve_v", "pressure_pa", "position_m"}


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
    lasts_s: float | None
    form: str
    """How the file was read."""
    columns: tuple[ImportedColumn, ...]
    """Every column of the file, in its order."""
    readings: tuple[ColumnReading, ...]
    findings: tuple[LogFinding, ...]
    map_text: str
    """The readings as a map, with what would mend them, where nothing was written."""


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
    table = read_table(source, import_map.hints() if import_map else TextHints())
    findings = LogFindings()
    for note in table.notes:
        findings.warning("file", note)
    for remark in table.remarks:
        findings.note("last-line", remark)
    chosen = _choose_by_map(table, import_map) if import_map else choose_by_header(table)
    for warning in chosen.warnings:
        findings.warning("gauge", warning)
    doubts = [(table.doubt, table.mend), *((c.bad_cell, c.mend) for c in chosen.columns)]
    if doubts := [(doubt, mend) for doubt, mend in doubts if doubt]:
        shown = _write_map(table, chosen.readings, import_map)
        shown = "\n".join([shown, *dict.fromkeys(mend for _, mend in doubts if mend)])
        text = "; ".join(doubt for doubt, _ in doubts)
        raise ImportRefused(show_map(f"{text}; with --map FILE, such as:", shown))
    _note_atmosphere(chosen.readings, findings)
    kept = _select_lines(table, import_map)
    rows = table.rows[kept]
    t_s, quantities = _convert_to_si(chosen, rows, kept)
    if t_s is None:
        t_s = _make_even_time(quantities, import_map)
        _judge_own_time(table, kept, rows, findings)
    time_name = _name_of(chosen, TIME) or "rate_hz"
    judge_record(t_s, quantities, rows, findings, time_name)
    better = list(chosen.readings)
    if not findings.any(Severity.ERROR):
        judge_clock(t_s, findings, time_name)
        better = judge_units(chosen.readings, quantities, findings)
        _judge_whole(quantities, findings)
    if accept_units:
        findings.soften("unit")
    stopped = findings.any(Severity.ERROR)
    columns = _describe_columns(table, chosen)
    if not stopped:
        t_s, quantities = _shift_columns(chosen.readings, t_s, quantities, findings)
        if resample_hz is not None:
            _note_resampling(t_s, resample_hz, findings)
            t_s, quantities = _resample_to_grid(t_s, quantities, resample_hz)
        story = _tell_story(source, len(rows), chosen, columns, findings, t_s, resample_hz)
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
        lasts_s=None if stopped else float(t_s[-1] - t_s[0]),
        form=table.form,
        columns=columns,
        readings=tuple(chosen.readings),
        findings=tuple(findings.summarise()),
        map_text=_write_map(table, better, import_map) if stopped else "",
    )


def _choose_by_map(table: MeasuredTable, import_map: ImportMap) -> ChosenColumns:
    """Return the columns that a map names."""
    readings, columns = [], []
    for reading in import_map.readings():
        column = table.find(reading.column)
        if column.is_text:
            raise ImportRefused(f"{column.name} holds {column.says or 'words'}, no numbers")
        readings.append(replace(reading, column=column.name))
        columns.append(column)
    used = [id(column) for column in columns]
    left_out = {
        number: "the map does not name it"
        for number, column in enumerate(table.columns, 1)
        if id(column) not in used
    }
    return ChosenColumns(readings, columns, left_out, [])


def _select_lines(table: MeasuredTable, import_map: ImportMap | None) -> slice:
    part = import_map.lines if import_map else None
    if part is None:
        return slice(None)
    last = table.rows[-1] if part.last is None and len(table.rows) else part.last or 0
    begin, end = np.searchsorted(table.rows, [part.first, last + 1])
    return slice(int(begin), int(end))


def _convert_to_si(
    chosen: ChosenColumns, rows: Ints, kept: slice
) -> tuple[Floats | None, dict[str, Floats]]:
    """Return the time and the quantities in SI; all have the same length."""
    lengths = {column.name: len(column.values) for column in chosen.columns}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ImportRefused(f"the columns differ in length: {listed}")
    found: dict[str, Floats] = {}
    for reading, column in zip(chosen.readings, chosen.columns, strict=True):
        raw = column.values[kept]
        with np.errstate(over="ignore", invalid="ignore"):
            values = reading.to_si(raw)
        lost = np.flatnonzero(np.isfinite(raw) & ~np.isfinite(values))
        if len(lost):
            detail = f"{column.name} is {raw[lost[0]]:g} {reading.unit} at row {rows[lost[0]]}"
            raise ImportRefused(f"{detail}: too large for a number in SI")
        found[reading.quantity] = values
    return found.pop(TIME, None), found


def _make_even_time(quantities: Mapping[str, Floats], import_map: ImportMap | None) -> Floats:
    rate_hz = import_map.time.rate_hz if import_map else None
    if rate_hz is None or not quantities:
        raise ImportRefused("no column of a measured quantity is named; there is nothing to import")
    return np.arange(len(next(iter(quantities.values())))) / rate_hz


def _judge_own_time(table: MeasuredTable, kept: slice, rows: Ints, findings: LogFindings) -> None:
    """Report what is wrong with the file's own time, which a rate in the map would hide."""
    for column in table.columns:
        meaning = understand_column(column)
        if meaning is None or meaning.quantity != TIME or not meaning.unit or column.is_text:
            continue
        own = LogFindings()
        values = ColumnReading(TIME, column.name, meaning.unit).to_si(column.values[kept])
        judge_record(values, {}, rows, own, column.name)
        for finding in own.all:
            if finding.kind != "jitter":
                findings.warning(finding.kind, f"rate_hz is used, but {finding.message}")
        return


def _note_atmosphere(readings: Sequence[ColumnReading], findings: LogFindings) -> None:
    """Say that the map's atmosphere is not that of a rig or a plant that states none."""
    for reading in readings:
        air_pa = reading.atmospheric_pressure_pa
        if reading.gauge and air_pa != ATMOSPHERIC_PRESSURE_PA:
            findings.warning(
                "atmosphere",
                f"{reading.quantity} counts from {air_pa:.6g} Pa, as the map says; the shipped "
                f"plant has {ATMOSPHERIC_PRESSURE_PA:.6g} Pa: give the plant file "
                f"atmospheric_pressure_pa: {air_pa:.6g}",
            )


def _name_of(chosen: ChosenColumns, quantity: str) -> str:
    return next((str(r.column) for r in chosen.readings if r.quantity == quantity), "")


def _judge_whole(quantities: Mapping[str, Floats], findings: LogFindings) -> None:
    if not {"pressure_pa", "position_m"} & quantities.keys():
        findings.error("columns", "there is neither pressure nor position: nothing was measured")
    elif missing := _MISSED - quantities.keys():
        detail = f"no {', '.join(sorted(missing))}: only analyses that do not need it are possible"
        findings.warning("columns", detail)


def _describe_columns(table: MeasuredTable, chosen: ChosenColumns) -> tuple[ImportedColumn, ...]:
    roles = {
        id(column): describe_reading(reading)
        for reading, column in zip(chosen.readings, chosen.columns, strict=True)
    }
    found = []
    for number, column in enumerate(table.columns, 1):
        read_as = roles.get(id(column), "")
        why = "" if read_as else chosen.left_out.get(number, "")
        if column.bad_cell:
            why += "; not all its cells are numbers"
        found.append(
            describe_column(number, column.name, column.values, read_as=read_as, left_out=why)
        )
    return tuple(found)


def describe_reading(reading: ColumnReading) -> str:
    """Return a quantity, the unit of its column, and what is done to it."""
    scaled = f" x {reading.gain:g}" if reading.gain != 1.0 else ""
    moved = f" {reading.offset:+g}" if reading.offset else ""
    gauge = " gauge" if reading.gauge else " absolute" if reading.quantity == "pressure_pa" else ""
    shift = f", shifted {reading.shift_s:+g} s" if reading.shift_s else ""
    return f"{reading.quantity}{scaled}{moved}, {reading.unit}{gauge}{shift}"


def _write_map(
    table: MeasuredTable, readings: Sequence[ColumnReading], import_map: ImportMap | None
) -> str:
    """Return a whole map: the readings, and what else the given map says."""
    lines = [write_map_line(table, reading) for reading in readings]
    if import_map:
        given = import_map.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
        if import_map.time.rate_hz:
            lines.insert(0, f"time: {{rate_hz: {import_map.time.rate_hz!r}}}")
        for key in (
            "atmospheric_pressure_pa",
            "encoding",
            "decimal",
            "date_order",
            "missing",
            "lines",
        ):
            if key in given:
                lines.append(f"{key}: {to_json(given[key]).decode()}")
    return "\n".join(lines)


# Shifts and resampling.


def _shift_columns(
    readings: Sequence[ColumnReading],
    t_s: Floats,
    quantities: Mapping[str, Floats],
    findings: LogFindings,
) -> tuple[Floats, dict[str, Floats]]:
    """Return the record with columns moved in time, without its ends where one of them is gone."""
    shifts = {r.quantity: r.shift_s for r in readings if r.shift_s and r.quantity in quantities}
    if not shifts:
        return t_s, dict(quantities)
    first = t_s[0] + max(0.0, *shifts.values())
    last = t_s[-1] + min(0.0, *shifts.values())
    kept = t_s[(t_s >= first - 1e-9) & (t_s <= last + 1e-9)]
    if len(kept) < 2:
        raise ImportRefused("shift_s moves the columns so far that they have no time in common")
    for name, shift_s in shifts.items():
        findings.note("shifted", f"{name} by {shift_s:+g} s")
    return kept, {
        name: _interpolate_at(kept - shifts.get(name, 0.0), t_s, values, name)
        for name, values in quantities.items()
    }


def resample_columns(
    t_s: Floats, quantities: Mapping[str, Floats], rate_hz: float
) -> tuple[Floats, dict[str, Floats]]:
    """Return times at `rate_hz` from the first time on, and the quantities at these times.

    Measured values are interpolated linearly, the valve command is held. Grid points within a gap
    are left out and count as missed.
    """
    # Include the last row if only rounding keeps it off the grid.
    count = int(np.floor((t_s[-1] - t_s[0]) * rate_hz * (1 + 1e-12) + 1e-9)) + 1
    grid = t_s[0] + np.arange(count) / rate_hz
    before = np.clip(np.searchsorted(t_s, grid, side="right") - 1, 0, len(t_s) - 2)
    step = np.diff(t_s)
    in_gap = step[before] > GAP_PERIODS * max(nominal_period_s(t_s), 1.0 / rate_hz)
    on_edge = (grid == t_s[before]) | (grid >= t_s[before + 1])
    kept = grid[~in_gap | on_edge]
    return kept, {
        name: _interpolate_at(kept, t_s, values, name) for name, values in quantities.items()
    }


def _interpolate_at(grid: Floats, t_s: Floats, values: Floats, name: str) -> Floats:
    if name == "valve_v":
        index = np.searchsorted(t_s, grid + 1e-9, side="right") - 1
        held: Floats = values[np.clip(index, 0, len(t_s) - 1)]
        return held
    return np.interp(grid, t_s, values)


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


# What the log keeps.


def _tell_story(
    source: Path,
    rows: int,
    chosen: ChosenColumns,
    columns: Sequence[ImportedColumn],
    findings: LogFindings,
    t_s: Floats,
    resample_hz: float | None,
) -> dict[str, str]:
    """Return the metadata record `import`: the source, and how the log was made from it."""
    left_out = {f"{c.number} {c.name}": c.left_out for c in columns if c.left_out}
    return {
        "source": escape_name(source.name),
        "sha256": _hash_file(source),
        "rows": str(rows),
        "first_t_s": repr(float(t_s[0])),
        "map": to_json([asdict(reading) for reading in chosen.readings]).decode(),
        "left_out": to_json(left_out).decode(),
        "resampled_hz": "" if resample_hz is None else repr(resample_hz),
        "report": to_json([finding._asdict() for finding in findings.summarise()]).decode(),
    }


def _hash_file(source: Path) -> str:
    with source.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
