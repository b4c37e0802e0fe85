"""Import a measured file: read it, choose its columns, check them, write the log, answer a page.

The log has the message of a run with fewer columns. The other system's clock and controller are
unknown: the log's wall time starts at zero, its configuration is empty, and its metadata states
the source.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.base.errors import Problem
from pamctl.base.new_file import create_new_file, require_place
from pamctl.base.texts import escape_name, to_json
from pamctl.log.check import LogFindings, Severity, list_findings
from pamctl.log.importing.column_map import (
    ATMOSPHERIC_PRESSURE_PA,
    ImportMap,
    TimeMap,
    describe_reading,
    write_map,
)
from pamctl.log.importing.column_roles import (
    choose_by_header,
    choose_by_map,
    names_quantity,
)
from pamctl.log.importing.file_formats import read_table
from pamctl.log.importing.headers import TIME, UNITS
from pamctl.log.importing.measured_table import (
    Floats,
    ImportRefused,
    MapWanted,
    MeasuredTable,
)
from pamctl.log.importing.plausibility import judge_clock, judge_record, judge_units
from pamctl.log.importing.shown_map import propose_missing, show_map
from pamctl.log.record_problems import round_to_steps
from pamctl.log.row_problems import GAP_PERIODS, find_gaps, nominal_period_s
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import IMPORTED, TICK_TOPIC, imported_fields
from pamctl.log.wire import TickLayout, make_message_records
from pamctl.log.writer import LogWriter, begin_log

MOST_TICKS = 50_000_000
"""Half a day at 1 kHz: protects against a mistyped rate."""
_MISSED = {"valve_v", "pressure_pa", "position_m"}
_OF_A_MECHANISM = {"position_m", "force_n"}
"""A mechanism of one axis misses nothing beside these."""
_OF_A_CHAMBER = {"valve_v", "pressure_pa"}
"""Nor does a chamber, where the file has no more columns."""


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
    map: ImportMap
    """How its columns are read."""
    findings: tuple[Problem, ...]
    map_text: str
    """The map as a text, with what would mend it, where nothing was written or much is left out."""


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
    found = _Import(read_table(source, import_map), import_map)
    found.convert_to_si()
    found.judge(is_accepted=accept_units)
    columns = found.describe_columns()
    written = not found.findings.any(Severity.ERROR)
    if written:
        found.shift_columns()
        if resample_hz is not None:
            found.resample(resample_hz)
        story = found.tell_story(source, columns, resample_hz)
        write_imported(destination, found.t_s - found.t_s[0], found.quantities, story)
    return ImportSummary(
        source=str(source),
        destination=str(destination),
        written=written,
        ticks=len(found.t_s) if written else 0,
        period_s=nominal_period_s(found.t_s) if written else None,
        lasts_s=float(found.t_s[-1] - found.t_s[0]) if written else None,
        form=found.table.form,
        columns=columns,
        map=found.map,
        findings=tuple(found.findings.summarise()),
        map_text=found.write_better_map(),
    )


class _Import:
    """A table on its way to a log: what is read from which column, and what is wrong with it."""

    def __init__(self, table: MeasuredTable, import_map: ImportMap | None) -> None:
        """Choose the columns; raise ImportRefused where they, or a cell, have no one reading."""
        self.table, self.has_map = table, import_map is not None
        self.chosen = choose_by_map(table, import_map) if import_map else choose_by_header(table)
        self.map = self.better_map = self.chosen.map
        self.findings = LogFindings()
        for note in table.notes:
            self.findings.warning("file", note)
        for remark in table.remarks:
            self.findings.note("file", remark)
        for kind, text in self.chosen.warnings:
            self.findings.warning(kind, text)
        self._refuse_doubts()
        self.kept = slice(None)
        if part := self.map.lines:
            last = table.rows[-1] if part.last is None and len(table.rows) else part.last or 0
            begin, end = np.searchsorted(table.rows, [part.first, last + 1])
            self.kept = slice(int(begin), int(end))
        self.rows = table.rows[self.kept]
        self.t_s: Floats = np.empty(0)
        self.quantities: dict[str, Floats] = {}

    def _refuse_doubts(self) -> None:
        """Raise ImportRefused, with a whole map, where the file or a column has no one reading."""
        columns = self.chosen.columns.values()
        doubts = [(self.table.doubt, self.table.mend), *((c.bad_cell, c.mend) for c in columns)]
        text = "; ".join(doubt for doubt, _ in doubts if doubt)
        if not text:
            return
        keys = self.map.as_keys()
        for _, mend in doubts:
            for key, value in mend.items():
                keys[key] = [*keys.get(key, []), *value] if key == "missing" else value
        lines = write_map(keys, {"decimal": "or ','", "date_order": "or m/d/y"}).splitlines()
        raise MapWanted(show_map(f"{text}; with --map FILE, such as:", lines))

    def convert_to_si(self) -> None:
        """Set the time and the quantities, all of one length; raise ImportRefused."""
        lengths = {c.name: len(c.values[self.kept]) for c in self.chosen.columns.values()}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
            why = f"the columns differ in length: {listed}"
            last = self.rows[max(min(lengths.values()), 1) - 1]
            lines = f"`lines: {{last: {last}}}` in the map takes the rows that all have"
            raise ImportRefused("; ".join([why, lines, *self.table.notes]))
        for quantity, column in self.chosen.columns.items():
            raw = column.values[self.kept]
            with np.errstate(over="ignore", invalid="ignore"):
                values = self.map.to_si(quantity, raw)
            lost = np.flatnonzero(np.isfinite(raw) & ~np.isfinite(values))
            if len(lost):
                unit = self.map.parts()[quantity].unit
                detail = f"{column.name} is {raw[lost[0]]:g} {unit} at row {self.rows[lost[0]]}"
                raise ImportRefused(f"{detail}: too large for a number in SI")
            self.quantities[quantity] = values
        if TIME in self.quantities:
            self.t_s = self.quantities.pop(TIME)
        elif self.map.time.rate_hz is None or not self.quantities:
            nothing = "no column of a measured quantity is named; there is nothing to import"
            raise ImportRefused(nothing)
        else:
            rows = len(next(iter(self.quantities.values())))
            self.t_s = np.arange(rows) / self.map.time.rate_hz

    def judge(self, *, is_accepted: bool) -> None:
        """Report what is wrong with the measurement, and what a reader of the log must know.

        `is_accepted`: a unit may look wrong.
        """
        findings, air_pa = self.findings, self.map.atmospheric_pressure_pa
        pressure = self.map.pressure
        if pressure and pressure.gauge and air_pa != ATMOSPHERIC_PRESSURE_PA:
            findings.note(
                "atmosphere",
                f"pressure_pa counts from {air_pa:.6g} Pa, as the map says; a plant file for this "
                f"log has atmospheric_pressure_pa: {air_pa:.6g}",
            )
        if TIME not in self.chosen.columns:
            self._judge_own_time()
        time_name = self.chosen.columns[TIME].name if TIME in self.chosen.columns else "rate_hz"
        judge_record(self.t_s, self.quantities, self.rows, findings, time_name)
        if findings.any(Severity.ERROR):
            self._replace_time()
            return
        judge_clock(self.t_s, findings, time_name)
        self.better_map = judge_units(
            self.chosen,
            {TIME: self.t_s, **self.quantities},
            findings,
            has_map=self.has_map,
            is_accepted=is_accepted,
        )
        there = self.quantities.keys()
        is_chamber = there == _OF_A_CHAMBER and not self.chosen.left_out
        is_whole = is_chamber or there >= _OF_A_MECHANISM
        if not {"pressure_pa", "position_m"} & there:
            findings.error(
                "columns", "there is neither pressure nor position: nothing was measured"
            )
        elif not is_whole and (missing := _MISSED - there):
            text = f"no {', '.join(sorted(missing))}: no analysis that needs this is possible"
            findings.warning("columns", text)

    def _replace_time(self) -> None:
        """Put a rate into the better map where times are missing or there twice, and none falls."""
        kinds = {f.key for f in self.findings.all if f.level == Severity.ERROR}
        step_s = np.diff(self.t_s)
        rises, falls = step_s[step_s > 0.0], (step_s < 0.0).any()
        if kinds <= {"missing", "duplicated"} and len(rises) and not falls:
            rate = TimeMap(rate_hz=float(f"{1.0 / float(np.median(rises)):.6g}"))
            self.better_map = self.map.model_copy(update={"time": rate})

    def _judge_own_time(self) -> None:
        """Report what is wrong with the file's own time, which a rate in the map would hide."""
        for column in self.table.columns:
            unit = column.header.unit
            if not names_quantity(column, TIME) or not unit or column.is_text:
                continue
            own = LogFindings()
            values = UNITS[TIME][unit] * column.values[self.kept]
            judge_record(values, {}, self.rows, own, column.name)
            for finding in own.all:
                if finding.key != "jitter":
                    self.findings.warning(finding.key, f"rate_hz is used, but {finding.message}")
            return

    def write_better_map(self) -> str:
        """Return the map that may mend an error, or may read what no header names; or nothing."""
        keys = write_map(self.better_map.as_keys(), {})
        misses = not self.has_map and any(f.key == "columns" for f in self.findings.all)
        lines = [keys, *(propose_missing(self.table, self.chosen.columns) if misses else [])]
        if self.findings.any(Severity.ERROR):
            if self.better_map == self.map:
                lines.insert(0, "# as it was read: change what is wrong")
            return "\n".join(lines)
        return "\n".join(lines) if len(lines) > 1 else ""

    def describe_columns(self) -> tuple[ImportedColumn, ...]:
        """Return what became of each column of the file."""
        parts, used = self.map.parts(), self.chosen.columns
        roles = {id(column): describe_reading(parts[q]) for q, column in used.items()}
        found = []
        for number, column in enumerate(self.table.columns, 1):
            read_as, values = roles.get(id(column), ""), column.values[self.kept]
            why = "" if read_as else self.chosen.left_out.get(number, "")
            if column.bad_cell:
                why += "; not all its cells are numbers"
            good = values[np.isfinite(values)]
            plot, rests = "", None
            if read_as and len(good) and not read_as.startswith(TIME):
                moves = np.abs(np.diff(_average(values, max(min(_PIECES, len(values) // 10), 1))))
                rests = float(np.mean(moves <= _STILL * np.ptp(good))) if len(moves) else None
                plot = _draw_course(values)
            low, high = (float(good.min()), float(good.max())) if len(good) else (None, None)
            gone = len(values) - len(good)
            found.append(
                ImportedColumn(number, column.name, read_as, why, low, high, gone, rests, plot)
            )
        return tuple(found)

    def shift_columns(self) -> None:
        """Move columns in time, and cut the ends off where one of them is gone."""
        parts = self.map.parts()
        shifts = {q: s for q in self.quantities if (s := getattr(parts[q], "shift_s", 0.0))}
        if not shifts:
            return
        first = self.t_s[0] + max(0.0, *shifts.values())
        last = self.t_s[-1] + min(0.0, *shifts.values())
        kept = self.t_s[(self.t_s >= first - 1e-9) & (self.t_s <= last + 1e-9)]
        if len(kept) < 2:
            raise ImportRefused("shift_s moves the columns so far that they have no time in common")
        for name, shift_s in shifts.items():
            self.findings.note("shifted", f"{name} by {shift_s:+g} s")
        self.quantities = {
            name: _interpolate_at(kept - shifts.get(name, 0.0), self.t_s, values, name)
            for name, values in self.quantities.items()
        }
        self.t_s = kept

    def resample(self, rate_hz: float) -> None:
        """Put the rows on an even grid; raise ImportRefused for too many ticks, or too few."""
        lasts_s, was_hz = self.t_s[-1] - self.t_s[0], 1.0 / nominal_period_s(self.t_s)
        ticks = lasts_s * rate_hz
        if ticks > MOST_TICKS:
            raise ImportRefused(
                f"--resample {rate_hz:g} would make {ticks:.3g} ticks: is it in Hz?"
            )
        self.findings.note(
            "resampled",
            f"from {was_hz:.6g} to {rate_hz:.6g} Hz; measured values interpolated, the command "
            "held",
        )
        if rate_hz < 0.9 * was_hz:
            detail = f"signals faster than {rate_hz / 2:.6g} Hz are aliased: there is no filter"
            self.findings.warning("aliasing", detail)
        self.t_s, self.quantities = resample_columns(self.t_s, self.quantities, rate_hz)
        if len(self.t_s) < 2:
            detail = f"--resample {rate_hz:g} leaves 1 tick of {lasts_s:.6g} s"
            way_out = f"give a rate in Hz nearer to the measurement's own {was_hz:.6g}"
            raise ImportRefused(f"{detail}; a measurement needs at least two: {way_out}")

    def tell_story(
        self, source: Path, columns: Sequence[ImportedColumn], resample_hz: float | None
    ) -> dict[str, str]:
        """Return the metadata record `import`: the source, and how the log was made from it."""
        with source.open("rb") as file:
            checksum = hashlib.file_digest(file, "sha256").hexdigest()
        left_out = {f"{c.number} {c.name}": c.left_out for c in columns if c.left_out}
        story = {
            "source": escape_name(source.name),
            "sha256": checksum,
            "rows": str(len(self.rows)),
            "first_t_s": repr(float(self.t_s[0])),
            "map": write_map(self.map.as_keys(), {}),
            "left_out": to_json(left_out).decode(),
            "resampled_hz": "" if resample_hz is None else repr(resample_hz),
            "report": to_json(list_findings(self.findings.summarise())).decode(),
        }
        if self.map.valve and self.map.valve.acts_after_s:
            story["acts_after_s"] = repr(self.map.valve.acts_after_s)
        if self.map.pressure and self.map.pressure.gauge:
            story["atmospheric_pressure_pa"] = repr(self.map.atmospheric_pressure_pa)
        if noise := self.map.stated_noise():
            story["noise"] = to_json(noise).decode()
        return story


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
    in_gap = find_gaps(t_s)[before] & (step[before] > GAP_PERIODS / rate_hz)
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
    return round_to_steps(np.interp(grid, t_s, values), values)


CHUNK_TICKS = 2048


def write_imported(
    path: str | Path, t_s: Floats, quantities: Mapping[str, Floats], story: Mapping[str, str]
) -> None:
    """Write a measurement into a new file.

    `t_s`, shape (n,) with n > 1, rises strictly from zero. `quantities` holds arrays of shape (n,)
    by their names in `IMPORTED_QUANTITIES`. `story` becomes the metadata record `import`.
    Raise NewFileError if it cannot be written.
    """
    fields = imported_fields(quantities)
    layout = TickLayout.of_fields(fields)
    messages = layout.encode(_build_table(t_s, quantities, layout))
    meta = RunMeta(
        str(path),
        metadata={"run": {"backend": IMPORTED}, "import": story},
        tick_fields=fields,
        origin=IMPORTED,
    )
    with create_new_file(Path(path)) as stream:
        writer = LogWriter(stream)
        channel = begin_log(writer, meta)[TICK_TOPIC]
        for start in range(0, len(t_s), CHUNK_TICKS):
            part = messages[start : start + CHUNK_TICKS]
            times_ns = np.rint(part["t_s"] * 1e9).astype(np.int64)
            writer.add(channel, make_message_records(part, times_ns, part["tick"]))
            writer.end_chunk()
        writer.finish()


def _build_table(t_s: Floats, quantities: Mapping[str, Floats], layout: TickLayout) -> NDArray[Any]:
    """Return the columns of the log as one structured array."""
    period_s = nominal_period_s(t_s)
    rows = np.maximum(2, np.rint(np.diff(t_s) / period_s))
    steps = np.where(find_gaps(t_s), rows, 1).astype(np.int64)
    columns = {
        "tick": np.concatenate(([0], np.cumsum(steps))),
        "t_s": t_s,
        "dt_s": np.concatenate(([period_s], np.diff(t_s))),
        "missed": np.concatenate(([0], steps - 1)),
        **quantities,
    }
    table = np.zeros(len(t_s), layout.dtype)
    for name in layout.names:
        table[name] = columns[name]
    return table


_BARS = (
    "\N{LOWER ONE EIGHTH BLOCK}\N{LOWER ONE QUARTER BLOCK}\N{LOWER THREE EIGHTHS BLOCK}"
    "\N{LOWER HALF BLOCK}\N{LOWER FIVE EIGHTHS BLOCK}\N{LOWER THREE QUARTERS BLOCK}"
    "\N{LOWER SEVEN EIGHTHS BLOCK}\N{FULL BLOCK}"
)
_PLOT_WIDTH = 32
_PIECES = 100
"""Parts of the record in which a column rests or not."""
_STILL = 0.002
"""A column whose mean moves by less than this share of its span from part to part rests."""


@dataclass(frozen=True)
class ImportedColumn:
    """A column of the file, and what became of it."""

    number: int
    name: str
    read_as: str
    """Quantity and unit; empty for a column that is left out."""
    left_out: str
    """Why; empty for a column that is used."""
    lowest: float | None
    """In the unit of the file."""
    highest: float | None
    missing: int
    rests: float | None
    """Share of the record in which it hardly moves."""
    plot: str
    """Its course in blocks, from its lowest to its highest value."""


def _draw_course(values: Floats) -> str:
    """Return the course of values of shape (n,) in blocks; a space where none are."""
    heights = _average(values, min(_PLOT_WIDTH, len(values)))
    low, span = np.nanmin(heights), np.nanmax(heights) - np.nanmin(heights)
    levels = np.nan_to_num((heights - low) / (span or 1.0) * (len(_BARS) - 1) + 0.5)
    return "".join(
        " " if np.isnan(height) else _BARS[int(level)]
        for height, level in zip(heights, levels, strict=True)
    )


def _average(values: Floats, count: int) -> Floats:
    """Return the means of so many pieces, shape (count,); NaN for one without values."""
    pieces = [piece[np.isfinite(piece)] for piece in np.array_split(values, count)]
    return np.array([piece.mean() if len(piece) else np.nan for piece in pieces])
