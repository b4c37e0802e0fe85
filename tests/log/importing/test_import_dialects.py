"""Tables in every dialect are read back to the number, or refused with line, cell and way on.

The table is known; only how it is written is drawn. A refusal is as good as an import: a wrong
number with exit code 0 is not.
"""

import bz2
import datetime as dt
import gzip
import lzma
import random
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from nptdms import ChannelObject, TdmsWriter
from pyarrow import parquet
from pydantic import TypeAdapter
from scipy.io import savemat

import pamctl.log
from pamctl.log.importing.column_map import ImportMap
from pamctl.log.importing.measured_table import ImportRefused
from pamctl.log.importing.pipeline import import_log
from pamctl.settings.resolve import RawSettings, validate_settings

ROWS = 40
T_S = np.arange(ROWS) * 0.05
ATMOSPHERE_PA = 101.3e3
TRUTH = {
    "valve_v": np.round(1.5 * np.sin(7.0 * T_S), 4),
    "pressure_pa": np.round(2.5 + 1.2 * np.sin(5.0 * T_S), 4),
    "force_n": np.round(950.0 + 360.0 * np.sin(5.0 * T_S)),
    "position_m": np.round(9000.0 + 4000.0 * np.sin(5.0 * T_S), 1),
}
HEADS = {
    "valve_v": ("Valve command", "V"),
    "pressure_pa": ("Pressure rel", "bar"),
    "force_n": ("Force", "N"),
    "position_m": ("Position", "um"),
}
TO_SI = {"valve_v": 1.0, "pressure_pa": 1e5, "force_n": 1.0, "position_m": 1e-6}
START = dt.datetime(2026, 3, 29, 0, 59, 59, tzinfo=dt.UTC)


def make_local(now: dt.datetime) -> dt.datetime:
    """Return the time in Berlin on the night when summer time begins."""
    hours = 1 if now < START + dt.timedelta(seconds=1) else 2
    return now.astimezone(dt.timezone(dt.timedelta(hours=hours)))


def milli(now: dt.datetime) -> str:
    return f"{now.microsecond // 1000:03d}"


CLOCKS: dict[str, Callable[[dt.datetime], str]] = {
    "elapsed": lambda t: f"00:{(t - START).seconds:02d}.{milli(t)}",
    "colons": lambda t: f"{t:%H:%M:%S}:{milli(t)}",
    "over a day": lambda t: f"{24 + t.hour}:{t:%M:%S}.{milli(t)}",
    "timedelta": lambda t: f"1 day, {t:%H:%M:%S}.{milli(t)}",
    "am pm": lambda t: f"{t:%m/%d/%Y %I:%M:%S}.{milli(t)} {t:%p}",
    "d/m/y": lambda t: f"{t:%d/%m/%Y %H:%M:%S}.{milli(t)}",
    "short year": lambda t: f"{t:%m/%d/%y %H:%M:%S}.{milli(t)}",
    "german": lambda t: f"{t:%d.%m.%Y %H:%M:%S},{milli(t)}",
    "matlab": lambda t: f"{t:%d-%b-%Y %H:%M:%S}.{milli(t)}",
    "american": lambda t: f"{t:%b %d, %Y %H:%M:%S}.{milli(t)}",
    "plain iso": lambda t: f"{t:%Y-%m-%d %H:%M:%S}.{milli(t)}",
    "zulu": lambda t: f"{t:%Y-%m-%dT%H:%M:%S}.{milli(t)}Z",
    "compact": lambda t: f"{t:%Y%m%dT%H%M%S}.{milli(t)}",
    "offset": lambda t: make_local(t).isoformat(timespec="milliseconds"),
    "comma, offset": lambda t: f"{make_local(t):%Y/%m/%d %H:%M:%S},{milli(t)} {make_local(t):%z}",
}
PACKED: dict[str, Callable[[bytes], bytes]] = {
    "": bytes, ".gz": gzip.compress, ".bz2": bz2.compress, ".xz": lzma.compress,
    ".zst": zstandard.compress,
}  # fmt: skip
NARROW_SPACE = "\N{NARROW NO-BREAK SPACE}"
ABOVE = ("Pr\u00fcfstand 3", "# by Kim", "Rate 20", "", "1;2;3", "5.4.2026")
NOTES = ("ok", 'said "go; on", 5', "1.5 bar?", "")


def write_time(form: str, index: int, decimal: str) -> str:
    """Return the time of a row, as seconds or as one of many clocks."""
    if form in CLOCKS:
        return CLOCKS[form](START + dt.timedelta(milliseconds=50 * index))
    text = f"{T_S[index]:.2f}" if form == "s" else f"{50 * index}"
    return text.replace(".", decimal)


def write_value(value: float, dialect: dict[str, Any]) -> str:
    """Return a number as this dialect writes it."""
    if dialect["spelling"] == "power":
        return f"{value:+.6E}".replace(".", dialect["decimal"])
    text = repr(float(value)).removesuffix(".0")
    sign, digits = ("-", text[1:]) if text.startswith("-") else ("", text)
    whole, _, fraction = digits.partition(".")
    if dialect["group"]:
        whole = f"{int(whole):,}".replace(",", dialect["group"])
    if dialect["spelling"] == "no zero" and fraction and whole == "0":
        whole = ""
    sign = sign.replace("-", "\N{MINUS SIGN}") if dialect["spelling"] == "minus sign" else sign
    text = sign + whole + (dialect["decimal"] + fraction if fraction else "")
    return f"{text:>10}" if dialect["spelling"] == "padded" else text


@st.composite
def dialects(draw: st.DrawFn) -> dict[str, Any]:
    delimiter = draw(st.sampled_from([",", ";", "\t", "|", "  ", " "]))
    decimal = draw(st.sampled_from([".", ","]))
    other = "," if decimal == "." else "."
    groups = ["", "", "'", other, NARROW_SPACE]
    spellings = ["plain", "plain", "power", "no zero", "minus sign", "padded"]
    is_spaced = not delimiter.strip(" ")
    return {
        "delimiter": delimiter,
        "decimal": decimal,
        "group": draw(st.sampled_from(groups)),
        "spelling": draw(st.sampled_from(spellings)),
        "quoting": draw(st.booleans()) and not is_spaced,
        "encoding": draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252"])),
        "packed": draw(st.sampled_from(["", "", *PACKED])),
        "end": draw(st.sampled_from(["\n", "\r\n", "\r"])),
        "above": draw(st.lists(st.sampled_from(ABOVE), max_size=3)),
        "units": draw(st.sampled_from(["name", "row", "bracketed row"])),
        "comment": draw(st.sampled_from(["", "", "# ", "%", "// "])),
        "time": draw(st.sampled_from(["s", "s", "ms", *CLOCKS])),
        "order": draw(st.permutations(["time", *TRUTH, "note"])),
        "note": draw(st.booleans()) and not is_spaced,
        "missing": draw(
            st.sampled_from(["", "NaN", "N/A", "#DIV/0!", "-", "null", "ERR", "-9999"])
        ),
        "missing_at": draw(st.sets(st.integers(0, ROWS - 1), max_size=3)),
        "missing_in": draw(st.sampled_from(["time", *TRUTH])),
        "odd_at": draw(st.sampled_from([0, 0, 0, 0, 7, ROWS])),
        "odd": draw(st.sampled_from(["", "pause", "# pause", "names", "short"])),
        "trailing": draw(st.booleans()) and not is_spaced,
        "cut": draw(st.sampled_from([0, 0, 0, 1, 2, 5, 9, 20, 60])),
    }


def write_table(dialect: dict[str, Any]) -> bytes:
    """Return the table as a file of text."""
    apart, decimal = dialect["delimiter"], dialect["decimal"]
    order = [name for name in dialect["order"] if name != "note" or dialect["note"]]
    is_clock = dialect["time"] in CLOCKS
    heads = {"time": ("Time", "" if is_clock else dialect["time"]), "note": ("Note", ""), **HEADS}

    def join(cells: list[str]) -> str:
        marks = (apart, '"') if apart.strip(" ") else ()
        quoted = [
            f'"{cell.replace(chr(34), 2 * chr(34))}"'
            if dialect["quoting"] or any(mark in cell for mark in marks)
            else cell
            for cell in cells
        ]
        return apart.join(quoted) + (apart if dialect["trailing"] else "")

    names, units = ([heads[name][at] for name in order] for at in (0, 1))
    if dialect["units"] == "name":
        names = [f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True)]
    names = [name.replace(" ", "_") if apart == " " else name for name in names]
    lines = [*dialect["above"], dialect["comment"] + join(names)]
    if dialect["units"] != "name":
        lines.append(join([f"[{u}]" if u and "[" in dialect["units"] else u or "-" for u in units]))
    for index in range(ROWS):
        cells = []
        for name in order:
            if index in dialect["missing_at"] and name == dialect["missing_in"]:
                cells.append(dialect["missing"])
            elif name == "time":
                cells.append(write_time(dialect["time"], index, decimal))
            elif name == "note":
                cells.append(NOTES[index % len(NOTES)])
            else:
                cells.append(write_value(TRUTH[name][index], dialect))
        lines.append(join(cells))
        if dialect["odd"] and index + 1 == dialect["odd_at"]:
            odd = {"names": join(names), "short": join(cells[:-1])}
            lines.append(odd.get(dialect["odd"], dialect["odd"]))
    text = dialect["end"].join(lines) + dialect["end"]
    text = text[: len(text) - dialect["cut"]] if dialect["cut"] else text
    if dialect["encoding"] == "cp1252":
        text = text.replace("\N{MINUS SIGN}", "-").replace(NARROW_SPACE, "\N{NO-BREAK SPACE}")
    return text.encode(dialect["encoding"])


def read_shown_map(text: str) -> ImportMap | None:
    """Return the map that a refusal shows, used as it stands; None where it shows none."""
    lines = [line for line in text.splitlines() if line.startswith("  ")]
    if not lines:
        return None
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", encoding="utf-8") as file:
        file.write("\n".join(lines))
        file.flush()
        return validate_settings(TypeAdapter(ImportMap), RawSettings.read(Path(file.name)))


def import_bytes(content: bytes, import_map: ImportMap | None = None) -> Any:
    """Return the summary and the signals; None for these where nothing was written."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "drawn.txt")
        source.write_bytes(content)
        done = import_log(source, Path(folder, "drawn.mcap"), import_map, accept_units=True)
        if not done.written:
            return done, None
        return done, pamctl.log.signals(pamctl.log.read(done.destination))


def require_way_on(content: bytes, refusal: str) -> None:
    """Follow the maps that refusals show: each is whole, and none leads in a circle."""
    seen: set[str] = set()
    while (import_map := read_shown_map(refusal)) is not None:
        assert refusal not in seen
        seen.add(refusal)
        try:
            import_bytes(content, import_map)
            return
        except ImportRefused as again:
            refusal = str(again)


def judge_dialect(dialect: dict[str, Any]) -> str:
    """Return "read" or "refused"; fail on a wrong number, or a refusal that names no place."""
    content = PACKED[dialect["packed"]](write_table(dialect))
    try:
        done, measured = import_bytes(content)
    except ImportRefused as refusal:
        assert re.search(r"(:\d+: |line \d+|--map|no rows of numbers)", str(refusal))  # noqa: PT017
        require_way_on(content, str(refusal))
        return "refused"
    if measured is None:
        assert any(finding.level == "error" for finding in done.findings)
        shown = read_shown_map("  " + done.map_text.replace("\n", "\n  "))
        assert shown is not None
        # Where times are missing, the map counts the rows.
        assert shown.time == done.map.time or shown.time.rate_hz == pytest.approx(20.0)
        assert shown.model_copy(update={"time": done.map.time}) == done.map
        return "refused"
    told = " ".join(finding.message for finding in done.findings)
    rows = len(measured.t_s)
    # What a cut took away is told; no row in the middle goes. A last line between spaces that lacks
    # a cell looks like one that was cut.
    looks_cut = dialect["cut"] or (not dialect["delimiter"].strip(" ") and not dialect["missing"])
    assert rows == ROWS or (looks_cut and ("left out" in told or rows >= ROWS - 3)), told
    np.testing.assert_allclose(measured.t_s, T_S[:rows], atol=1e-9)
    for name, values in TRUTH.items():
        got = getattr(measured, name)
        if got is None:
            assert any(column.left_out for column in done.columns)
            continue
        expected = values[:rows].copy()
        if name == dialect["missing_in"]:
            gone = [index for index in dialect["missing_at"] if index < rows]
            expected[gone] = -9999.0 if dialect["missing"] == "-9999" else np.nan
            assert not gone or "missing" in told or dialect["missing"] == "-9999"
        shift = ATMOSPHERE_PA if name == "pressure_pa" else 0.0
        last = slice(None, -1) if "nothing ends line" in told else slice(None)
        np.testing.assert_allclose(
            (got - shift)[last], expected[last] * TO_SI[name], rtol=1e-9, atol=1e-7 * TO_SI[name]
        )
    return "read"


@settings(max_examples=50, deadline=None)
@given(dialects())
def test_a_table_is_read_back_or_refused_in_every_dialect(dialect):
    judge_dialect(dialect)


def write_sheet(path: Path, columns: dict[str, Any], units: Mapping[str, str]) -> None:
    book = openpyxl.Workbook()
    sheet = book.worksheets[0]
    sheet.append(["Bench 3"])
    sheet.append(list(columns))
    sheet.append([units.get(name, "-") for name in columns])
    for row in zip(*(values.tolist() for values in columns.values()), strict=True):
        sheet.append([None if cell != cell else cell for cell in row])
    book.save(path)


def write_tdms(path: Path, columns: dict[str, Any], units: Mapping[str, str]) -> None:
    with TdmsWriter(path) as writer:
        for part in (slice(0, 7), slice(7, ROWS)):
            channels = [
                ChannelObject("G", name, values[part], {"unit_string": units.get(name, "")})
                for name, values in columns.items()
            ]
            writer.write_segment(channels)


def write_hdf5(path: Path, columns: dict[str, Any]) -> None:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[f"run/{name}"] = values


def write_records(path: Path, columns: dict[str, Any]) -> None:
    table = np.zeros(
        len(next(iter(columns.values()))),
        [(name, values.dtype) for name, values in columns.items()],
    )
    for name, values in columns.items():
        table[name] = values
    np.save(path, table)


PLAIN_NAMES = {
    "time": "t_s", "valve_v": "valve_v", "pressure_pa": "pressure_gauge_bar", "force_n": "force_n",
    "position_m": "position_um",
}  # fmt: skip
WRITERS: dict[str, Callable[[Path, dict[str, Any]], Any]] = {
    "a.npz": lambda path, columns: np.savez_compressed(path, **columns),
    "a.npy": write_records,
    "a.parquet": lambda path, columns: parquet.write_table(pa.table(columns), path),
    "a.h5": write_hdf5,
    "v7.mat": lambda path, columns: savemat(path, {"run": columns}, do_compression=True),
    "v4.mat": lambda path, columns: savemat(path, columns, format="4"),
    "a.xlsx": lambda path, columns: write_sheet(path, columns, {}),
}


@pytest.mark.parametrize("name", [*WRITERS, "units.xlsx", "a.tdms"])
def test_a_table_of_any_program_is_read_back(name, tmp_path, parsed_here):
    chance = random.Random(name)
    truth = {"time": T_S, **{key: values.copy() for key, values in TRUTH.items()}}
    truth["position_m"][chance.sample(range(ROWS), 3)] = np.nan
    truth["force_n"] = truth["force_n"].astype(np.int32)
    order = chance.sample(list(truth), len(truth))
    path = tmp_path / name
    if name in WRITERS:
        WRITERS[name](path, {PLAIN_NAMES[key]: truth[key] for key in order})
    else:
        heads = {"time": ("Time", "s"), **HEADS}
        write = write_tdms if name == "a.tdms" else write_sheet
        write(path, {heads[key][0]: truth[key] for key in order}, dict(heads.values()))
    path = path.rename(tmp_path / "b.dat") if name.startswith("a.n") else path
    done = import_log(path, tmp_path / "a.mcap", accept_units=True)
    assert done.written, done.findings
    measured = pamctl.log.signals(pamctl.log.read(done.destination))
    np.testing.assert_allclose(measured.t_s, T_S, atol=1e-9)
    for key in TRUTH:
        shift = ATMOSPHERE_PA if key == "pressure_pa" else 0.0
        got = (getattr(measured, key) - shift) / TO_SI[key]
        np.testing.assert_allclose(got, truth[key], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("text", ["1.016", "1,016"])
def test_three_digits_behind_every_mark_beside_whole_numbers_are_refused_with_the_line(
    tmp_path, text
):
    rows = "".join(f"{50 * k}\t{990 + k}\t{text}\n" for k in range(20))
    source = tmp_path / "a.txt"
    source.write_text("Time [ms]\tForce [N]\tPosition [um]\n" + rows)
    with pytest.raises(ImportRefused, match="line 2 may be thousands or a fraction"):
        import_log(source, tmp_path / "a.mcap")
