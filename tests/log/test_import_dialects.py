"""Tables in every dialect are read back to the number, or refused with line, cell and way on.

The table is known; only how it is written is drawn. A refusal is as good as an import: a wrong
number with exit code 0 is not.
"""

from __future__ import annotations

import datetime as dt
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pamctl.log
from pamctl.log.importing.measured_table import ImportRefused
from pamctl.log.importing.pipeline import import_log

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


def write_time(form: str, index: int) -> str:
    """Return the time of a row, as seconds or as one of many clocks."""
    now = START + dt.timedelta(milliseconds=50 * index)
    millis = now.microsecond // 1000
    if form == "s":
        return f"{T_S[index]:.2f}"
    if form == "ms":
        return f"{50 * index}"
    if form == "elapsed":
        return f"{0:02d}:{int(T_S[index]):02d}.{millis:03d}"
    if form == "colons":
        return now.strftime("%H:%M:%S:") + f"{millis:03d}"
    if form == "am_pm":
        return now.strftime("%m/%d/%Y %I:%M:%S.") + f"{millis:03d} " + now.strftime("%p")
    if form == "german":
        return now.strftime("%d.%m.%Y %H:%M:%S,") + f"{millis:03d}"
    if form == "matlab":
        return now.strftime("%d-%b-%Y %H:%M:%S.") + f"{millis:03d}"
    hours = 1 if now < START + dt.timedelta(seconds=1) else 2  # summer time begins
    local = now.astimezone(dt.timezone(dt.timedelta(hours=hours)))
    return local.isoformat(timespec="milliseconds")


def write_value(value: float, decimal: str, group: str) -> str:
    text = repr(float(value)).removesuffix(".0")
    sign, digits = ("-", text[1:]) if text.startswith("-") else ("", text)
    whole, _, fraction = digits.partition(".")
    if group:
        whole = f"{int(whole):,}".replace(",", group)
    return sign + whole + (decimal + fraction if fraction else "")


@st.composite
def dialects(draw: st.DrawFn) -> dict[str, Any]:
    delimiter = draw(st.sampled_from([",", ";", "\t", "|", "  "]))
    decimal = draw(st.sampled_from([".", ","]))
    return {
        "delimiter": delimiter,
        "decimal": decimal,
        "group": draw(st.sampled_from(["", "", "'", "," if decimal == "." else "."])),
        "quoting": draw(st.booleans()) if delimiter != "  " else False,
        "encoding": draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"])),
        "end": draw(st.sampled_from(["\n", "\r\n", "\r"])),
        "above": draw(
            st.lists(st.sampled_from(["Pr\u00fcfstand 3", "# by Kim", "Rate 20"]), max_size=3)
        ),
        "units": draw(st.sampled_from(["name", "row", "bracketed row"])),
        "comment": draw(st.sampled_from(["", "# ", "%"])),
        "time": draw(
            st.sampled_from(["s", "ms", "elapsed", "colons", "am_pm", "german", "matlab", "iso"])
        ),
        "missing": draw(st.sampled_from(["", "NaN", "N/A", "#DIV/0!", "-", "null", "ERR"])),
        "missing_at": draw(st.sets(st.integers(0, ROWS - 1), max_size=3)),
        "missing_in": draw(st.sampled_from(list(TRUTH))),
        "trailing": draw(st.booleans()) if delimiter != "  " else False,
        "cut": draw(st.sampled_from([0, 0, 0, 1, 2, 5, 9, 20, 60])),
    }


def write_table(dialect: dict[str, Any]) -> bytes:
    apart, decimal = dialect["delimiter"], dialect["decimal"]
    names, units = ["Time"], ["" if dialect["time"] not in ("s", "ms") else dialect["time"]]
    for name, unit in HEADS.values():
        names.append(name)
        units.append(unit)
    if dialect["units"] == "name":
        names = [f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True)]
    lines = [*dialect["above"], dialect["comment"] + apart.join(names)]
    if dialect["units"] != "name":
        row = [f"[{u}]" if u and "[" in dialect["units"] else u or "-" for u in units]
        lines.append(apart.join(row))
    for index in range(ROWS):
        stamp = write_time(dialect["time"], index)
        cells = [stamp.replace(".", decimal) if dialect["time"] in ("s", "ms") else stamp]
        for name, values in TRUTH.items():
            gone = index in dialect["missing_at"] and name == dialect["missing_in"]
            text = write_value(values[index], decimal, dialect["group"])
            cells.append(dialect["missing"] if gone else text)
        if dialect["quoting"] or (apart == "," and any("," in cell for cell in cells)):
            cells = [f'"{cell}"' for cell in cells]
        lines.append(apart.join(cells) + (apart if dialect["trailing"] else ""))
    text = dialect["end"].join(lines) + dialect["end"]
    text = text[: len(text) - dialect["cut"]] if dialect["cut"] else text
    return text.encode(dialect["encoding"])


def import_bytes(content: bytes) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "drawn.txt")
        source.write_bytes(content)
        done = import_log(source, Path(folder, "drawn.mcap"), accept_units=True)
        if not done.written:
            return done, None
        return done, pamctl.log.signals(pamctl.log.read(done.destination))


@settings(max_examples=150, deadline=None)
@given(dialects())
def test_a_table_is_read_back_or_refused_in_every_dialect(dialect):
    content = write_table(dialect)
    try:
        done, measured = import_bytes(content)
    except ImportRefused as refusal:
        assert re.search(r"(:\d+: |line \d+).*", str(refusal))  # noqa: PT017
        return
    if measured is None:
        assert any(finding.severity == "error" for finding in done.findings)
        return
    told = " ".join(finding.message for finding in done.findings)
    rows = len(measured.t_s)
    # What a cut took away is told; no row in the middle goes.
    assert rows == ROWS or (dialect["cut"] and ("left out" in told or rows >= ROWS - 3)), told
    np.testing.assert_allclose(measured.t_s, T_S[:rows], atol=1e-9)
    for name, values in TRUTH.items():
        expected = values[:rows].copy()
        if name == dialect["missing_in"]:
            gone = [index for index in dialect["missing_at"] if index < rows]
            expected[gone] = np.nan
            assert not gone or "missing" in told
        got = getattr(measured, name)
        shift = ATMOSPHERE_PA if name == "pressure_pa" else 0.0
        last = slice(None, -1) if "nothing ends line" in told else slice(None)
        np.testing.assert_allclose(
            (got - shift)[last], expected[last] * TO_SI[name], rtol=1e-9, atol=1e-7 * TO_SI[name]
        )


@pytest.mark.parametrize("text", ["1.016", "1,016"])
def test_three_digits_behind_every_mark_beside_whole_numbers_are_refused_with_the_line(
    tmp_path, text
):
    rows = "".join(f"{50 * k}\t{990 + k}\t{text}\n" for k in range(20))
    source = tmp_path / "a.txt"
    source.write_text("Time [ms]\tForce [N]\tPosition [um]\n" + rows)
    with pytest.raises(ImportRefused, match="line 2 may be thousands or a fraction"):
        import_log(source, tmp_path / "a.mcap")
