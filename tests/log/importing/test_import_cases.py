"""Kinds of files from public reports that were read wrongly, and their siblings.

All hold one measurement of 60 rows, 50 ms apart. Read right is: these numbers, or a refusal.
"""

import bz2
import datetime as dt
import gzip
import lzma
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
import zstandard
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat
from test_import_dialects import CLOCKS
from test_log_import import ATMOSPHERE_PA, Outcome

T_S = np.round(np.arange(60) * 0.05, 2)
VALVE_V = np.round(1.5 * np.sin(3.0 * T_S), 4)
BAR = np.round(2.5 + 1.2 * np.sin(4.0 * T_S), 4)
MM = np.round(9.0 + 4.0 * np.sin(4.0 * T_S), 3)
HEAD = ("Time [s]", "Valve command [V]", "Pressure [bar gauge]", "Position [mm]")
GOOD = (T_S, VALVE_V, BAR, MM)
START = dt.datetime(2026, 3, 29, 0, 59, 58, 500_000, tzinfo=dt.UTC)


def table(head: Any = HEAD, columns: Any = GOOD, apart: str = ",", end: str = "\n") -> str:
    rows = zip(*([str(cell) for cell in column] for column in columns), strict=True)
    return "".join(apart.join(row) + end for row in [head, *rows])


def write(folder: Path, content: str | bytes, name: str = "a.csv") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def require_good(done: Outcome, t_s: Any = T_S, rows: int = 60) -> None:
    assert done.code == 0, done.stderr + str(done.report)
    measured = done.signals
    np.testing.assert_allclose(measured.t_s, t_s[:rows], atol=1e-9)
    np.testing.assert_allclose(measured.valve_v, VALVE_V[:rows], atol=1e-12)
    np.testing.assert_allclose(measured.pressure_pa, BAR[:rows] * 1e5 + ATMOSPHERE_PA, atol=1e-6)
    np.testing.assert_allclose(measured.position_m, MM[:rows] * 1e-3, atol=1e-12)


def left_out(done: Outcome) -> list[str]:
    return [column["name"] for column in done.report["columns"] if column["left_out"]]


# The mark of fractions.


def test_a_map_says_which_mark_it_is_where_no_number_does(tmp_path):
    head = ("Time [ms]", "Position [um]")
    path = write(tmp_path, table(head, ((T_S * 1000).astype(int), ["1,016"] * 60), "\t"))
    text = Outcome(path).shown_map
    for decimal, value_m in ((".", 1016e-6), (",", 1.016e-6)):
        map_path = write(tmp_path, text.replace("decimal: '.'", f"decimal: '{decimal}'"), "m.yaml")
        done = Outcome(path, "--map", str(map_path))
        assert done.signals.position_m[0] == pytest.approx(value_m)
        done.path.unlink()


# Clocks.


def clock_rows(spell: Callable[[dt.datetime], str], start: dt.datetime = START) -> list[str]:
    return [spell(start + dt.timedelta(milliseconds=50 * k)) for k in range(60)]


@pytest.mark.parametrize("form", sorted(set(CLOCKS) - {"elapsed"}))
def test_a_clock_of_any_common_form_is_read(tmp_path, form):
    head = ("Time", *HEAD[1:])
    times = clock_rows(CLOCKS[form])
    require_good(Outcome(write(tmp_path, table(head, (times, *GOOD[1:]), ";"))))


@pytest.mark.parametrize(
    ("times", "told"),
    [
        (clock_rows(lambda t: f"week 13, {t:%H.%M}"), "words, no numbers"),
        ([*clock_rows(CLOCKS["plain iso"])[:59], "12:00:00"], ":61: Time is '12:00:00', but"),
        (clock_rows(lambda t: f"{t:%H:%M}"), "may be hours and minutes, or minutes and seconds"),
        (["3/4/2026 12:00:00"] * 30 + ["5/7/2026 12:00:00"] * 30, "does not tell day from month"),
    ],
)
def test_a_clock_that_has_no_reading_is_refused_and_never_dropped(tmp_path, times, told):
    head = ("Time", *HEAD[1:])
    done = Outcome(write(tmp_path, table(head, (times, *GOOD[1:]), ";")))
    assert done.code == 65
    assert told in done.stderr


def test_dates_beside_the_times_count_the_days(tmp_path):
    late = dt.datetime(2026, 3, 1, 23, 59, 59, tzinfo=dt.UTC)
    dates = clock_rows(lambda t: t.strftime("%d.%m.%Y"), late)
    dates[30:] = [text.replace("02.03.", "05.03.") for text in dates[30:]]
    times = clock_rows(CLOCKS["colons"], late)
    done = Outcome(write(tmp_path, table(("Date", "Time", *HEAD[1:]), (dates, times, *GOOD[1:]))))
    assert "3 gaps" not in done.stderr
    require_good(done, T_S + 3 * 86400.0 * (np.arange(60) >= 30))


def test_elapsed_times_of_excel_beyond_a_day_are_exact(tmp_path, parsed_here):
    book = openpyxl.Workbook()
    sheet = book.worksheets[0]
    sheet.append(["Time", *HEAD[1:]])
    for k, row in enumerate(zip(*GOOD[1:], strict=True)):
        sheet.append([dt.timedelta(days=1, seconds=-1.5 + 0.05 * k), *map(float, row)])
        sheet.cell(k + 2, 1).number_format = "[h]:mm:ss.000"
    book.save(tmp_path / "a.xlsx")
    require_good(Outcome(tmp_path / "a.xlsx"))


# Cells and columns.


@pytest.mark.parametrize(
    ("name", "pascals"),
    [("Pressure (hPa abs)", 100.0), ("Druck / mmHg abs", 133.322387415),
     ("Pressure (Torr abs)", 133.3223684), ("Druck / atm abs", 101325.0),
     ("Pressure (kgf/cm2 abs)", 98066.5), ("Druck / inHg abs", 3386.388640341)],
)  # fmt: skip
def test_a_pressure_in_any_usual_unit_is_read(tmp_path, name, pascals):
    values = (BAR * 1e5 + ATMOSPHERE_PA) / pascals
    done = Outcome(write(tmp_path, table((*HEAD[:2], name, HEAD[3]), (T_S, VALVE_V, values, MM))))
    np.testing.assert_allclose(done.signals.pressure_pa, BAR * 1e5 + ATMOSPHERE_PA, rtol=1e-6)


def test_a_text_with_a_head_like_labviews_and_a_time_of_day_is_read_as_a_text(tmp_path):
    head = "LabVIEW Measurement\nOperator\tKim\n***End_of_Header***\n\n"
    rows = table(("Time of day", *HEAD[1:]), (clock_rows(CLOCKS["colons"]), *GOOD[1:]), "\t")
    require_good(Outcome(write(tmp_path, head + rows)))


@pytest.mark.parametrize(
    ("at", "name", "told"),
    [
        (1, "Valve current [A]", None),
        (1, "Valve [%]", "'%', which is no unit of valve_v"),
        (2, "Pressure (furlong)", "'furlong', which is no unit of pressure_pa"),
        (2, "Pressure", "'Pressure' states no unit"),
        (3, "Position [counts]", "um, in): `gain` and `offset` in the map turn it into one"),
    ],
)
def test_a_quantity_without_its_unit_is_asked_for_and_never_dropped(tmp_path, at, name, told):
    head = (*HEAD[:at], name, *HEAD[at + 1 :])
    path = write(tmp_path, table(head))
    done = Outcome(path)
    if told is None:  # a current is no command
        assert left_out(done) == [name]
        return
    assert done.code == 65
    assert told in done.stderr
    assert f"column: '{name}'" in done.shown_map
    assert Outcome(path, "--map", str(write(tmp_path, done.shown_map, "map.yaml"))).code == 0


@pytest.mark.parametrize(("every", "unit"), [(1e-3, "s"), (1, "ms"), (1000, "us"), (10**6, "ns")])
def test_a_time_without_its_unit_is_proposed_in_that_of_a_rig_of_1_khz(tmp_path, every, unit):
    times = [round(k * every, 3) for k in range(60)]
    refused = Outcome(write(tmp_path, table(("stamp", *HEAD[1:]), (times, *GOOD[1:]))))
    assert f"time: {{column: 'stamp', unit: {unit}}}" in refused.shown_map


# Header lines, ragged lines, lines that are cut.


def test_a_time_column_per_channel_is_imported_by_number(tmp_path):
    columns = (T_S, VALVE_V, T_S, BAR, T_S, MM)
    stamp = "2026-03-16 17:04:51"
    head = [
        ",".join(["Timestamp", stamp] * 3),
        ",".join(["Interval", "0.05"] * 3),
        'Channel name,"Valve command",Channel name,"Pressure rel",Channel name,"Position"',
        'Unit,"V",Unit,"bar",Unit,"mm"',
    ]
    text = "\n".join(head) + "\n" + table((), columns).lstrip("\n")
    path = write(tmp_path, text)
    shown = Outcome(path).stderr
    for time in ("3", "'Channel name'"):
        text = f"time: {{column: {time}}}\n" + "\n".join(
            line for line in shown.splitlines() if line.startswith("  ") and "time:" not in line
        ).replace("  ", "")
        done = Outcome(path, "--map", str(write(tmp_path, text, "map.yaml")))
        require_good(done)
        done.path.unlink()


def test_equal_time_columns_count_as_one_and_others_do_not(tmp_path):
    head = (HEAD[0], HEAD[1], HEAD[0], HEAD[2], HEAD[0], HEAD[3])
    columns = (T_S, VALVE_V, T_S, BAR, T_S, MM)
    done = Outcome(write(tmp_path, table(head, columns)))
    require_good(done)
    assert "the same time as in column 1" in str(done.report["columns"])
    other = (T_S, VALVE_V, T_S + 0.01, BAR, T_S, MM)
    assert "may each be t_s" in Outcome(write(tmp_path, table(head, other), "b.csv")).stderr


@pytest.mark.parametrize("apart", ["\t", ";", ","])
def test_a_last_column_without_a_cell_keeps_the_names_of_all(tmp_path, apart):
    columns = (*GOOD, [""] * len(T_S))
    done = Outcome(write(tmp_path, table((*HEAD, "Comment"), columns, apart), "a.txt"))
    require_good(done)
    assert left_out(done) == ["Comment"]


def test_a_line_break_within_quotes_is_no_line(tmp_path):
    head = tuple(f'"{name.replace(" [", chr(10) + "[")}"' for name in HEAD)
    require_good(Outcome(write(tmp_path, table(head, end="\r\n"))))


# What changes inside a file.


def write_tdms(path: Path, **later: Any) -> Path:
    """Write two acquisitions into one file; `later` are properties of the second one."""
    begin = np.datetime64("2026-05-04T12:00:00")
    with TdmsWriter(path) as writer:
        for half in (slice(0, 30), slice(30, 60)):
            again = later if half.start else {}
            wave = {"wf_increment": 0.05, "wf_start_time": begin, "unit_string": "", **again}
            writer.write_segment(
                [
                    ChannelObject("G", name, values[half], {**wave, "unit_string": unit})
                    for name, values, unit in (
                        ("Valve command", VALVE_V, "V"), ("Pressure rel", BAR, "bar"),
                        ("Position", MM, later.get("unit", "mm") if half.start else "mm"),
                        ("T_amb", T_S, ""),
                    )
                ]
            )  # fmt: skip
    return path


def test_a_pause_between_two_acquisitions_of_a_tdms_file_is_a_gap(tmp_path, parsed_here):
    start = np.datetime64("2026-05-04T12:10:00")
    done = Outcome(write_tdms(tmp_path / "a.tdms", wf_start_time=start))
    expected = np.where(np.arange(60) < 30, T_S, 600.0 + T_S - 1.5)
    require_good(done, expected)
    assert "598.55 s" in done.said["warning", "gap"]


def test_an_interval_that_changes_is_followed_and_another_unit_is_refused(tmp_path, parsed_here):
    done = Outcome(write_tdms(tmp_path / "a.tdms", wf_increment=0.1))
    require_good(done, np.where(np.arange(60) < 30, T_S, 1.5 + (np.arange(60) - 30) * 0.1))
    refused = Outcome(write_tdms(tmp_path / "b.tdms", unit="um")).stderr
    assert "Position changes unit_string from 'mm' to 'um' at value 31" in refused


def test_a_second_recording_in_a_file_has_a_way_on_and_a_rate_does_not_hide_it(tmp_path):
    columns = [np.concatenate([column, column[:40]]) for column in GOOD]
    columns[0][60:] = T_S[:40] + 1.0
    path = write(tmp_path, table(columns=columns))
    done = Outcome(path)
    assert "`lines: {first: 1, last: 61}`" in done.said["error", "backwards"]
    shown = done.report["map_text"]
    part = write(tmp_path, f"{shown}\nlines: {{first: 1, last: 61}}", "map.yaml")
    first = Outcome(path, "--map", str(part))
    require_good(first)
    assert first.report["columns"][0]["highest"] == pytest.approx(T_S[-1])  # of its part, not all
    first.path.unlink()
    rate = shown.replace("time: {column: 'Time [s]', unit: s}", "time: {rate_hz: 20}")
    hidden = Outcome(path, "--map", str(write(tmp_path, rate, "map.yaml")))
    assert "rate_hz is used, but the time (Time [s])" in hidden.said["warning", "backwards"]


# Other formats, and how they are found.


def test_a_matrix_with_a_signal_a_row_is_imported_by_its_rows(tmp_path, parsed_here):
    path = tmp_path / "a.mat"
    savemat(path, {"data": np.array(GOOD)})
    text = "time: {column: 'data(1,:)'}\nvalve: {column: 'data(2,:)'}\n"
    text += "pressure: {column: 3, unit: bar, gauge: true}\nposition: {column: 4, unit: mm}\n"
    require_good(Outcome(path, "--map", str(write(tmp_path, text, "map.yaml"))))


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress, zstandard.compress])
def test_a_packed_text_is_found_by_its_first_bytes_whatever_it_is_called(tmp_path, pack):
    packed = pack(table().encode())
    require_good(Outcome(write(tmp_path, packed, "a.dat")))
    for hurt in (packed[:50] + packed[60:], packed[:-60]):
        done = Outcome(write(tmp_path, hurt, "b.dat"))
        assert (done.code, "is damaged" in done.stderr) == (65, True)


@pytest.mark.parametrize(
    ("begin", "told"),
    [
        (b"#ROSBAG V2.0\n", "a ROS bag; export its topics as CSV"),
        (b"\x89MCAP0\r\n", "a log of pamctl needs no import"),
        (b"SQLite format 3\0", "ROS 2 bags"),
        (b"\x00\x01\x02\x03\x04\x05\x06\x07", "it begins with 00 01 02 03"),
        (b"MDF     4.10", "asammdf"),
        (b"\xd0\xcf\x11\xe0", "save it as .xlsx or CSV"),
    ],
)
def test_a_format_that_cannot_be_read_is_named_with_the_way_on(tmp_path, begin, told):
    done = Outcome(write(tmp_path, begin + bytes(500)))
    assert done.code == 65
    assert told in done.stderr


def test_a_packed_bomb_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr("pamctl.log.importing.file_formats.BOMB_BYTES", 1 << 20)
    packed = gzip.compress(b"0,0\n" * 1_000_000)
    assert "unpacks to more than 1 MB" in Outcome(write(tmp_path, packed, "a.gz")).stderr


# Keys of the map.


def test_gain_offset_and_a_shift_in_time_are_keys_of_a_column(tmp_path):
    late = np.interp(T_S - 0.1, T_S, MM)
    path = write(tmp_path, table(columns=(T_S, VALVE_V * 2 + 5, BAR, late * 10)))
    text = (
        "time: {column: 1}\nvalve: {column: 2, gain: 0.5, offset: -2.5}\n"
        "pressure: {column: 3, unit: bar, gauge: true}\n"
        "position: {column: 4, unit: mm, gain: 0.1, shift_s: -0.1}\n"
    )
    done = Outcome(path, "--map", str(write(tmp_path, text, "map.yaml")))
    measured = done.signals
    assert len(measured.t_s) == 58  # the last two rows have no position any more
    np.testing.assert_allclose(measured.position_m, MM[:58] * 1e-3, atol=1e-9)
    np.testing.assert_allclose(measured.valve_v, VALVE_V[:58], atol=1e-9)


def test_a_column_shifted_by_part_of_a_row_keeps_the_steps_of_its_sensor(tmp_path):
    t_s = np.round(np.arange(2000) * 1e-3, 4)
    slow = 2.0 - 2.0 * np.cos(4.0 * t_s) + np.random.default_rng(4).normal(0.0, 0.0015, 2000)
    coarse = np.round(slow / 0.005) * 0.005  # mm
    coarse[:500] = coarse[0]  # rests, but for a flicker between two steps
    coarse[100:500:37] += 0.005
    path = write(tmp_path, table(("Time [s]", "Position [mm]"), (t_s, coarse)))
    text = "time: {column: 1}\nposition: {column: 2, unit: mm, shift_s: -0.00348}\n"
    done = Outcome(path, "--map", str(write(tmp_path, text, "map.yaml")))
    shifted = 1e3 * done.signals.position_m
    np.testing.assert_allclose(shifted, np.round(shifted / 0.005) * 0.005, atol=1e-9)
    straight = np.interp(done.signals.t_s + 0.00348, t_s, coarse)
    assert np.abs(shifted - straight).max() <= 0.0025 + 1e-9


def test_an_atmosphere_that_is_not_the_usual_one_is_told(tmp_path):
    text = (
        "time: {column: 1}\npressure: {column: 3, unit: bar, gauge: true}\n"
        "position: {column: 4, unit: mm}\natmospheric_pressure_pa: 95000\n"
    )
    done = Outcome(write(tmp_path, table()), "--map", str(write(tmp_path, text, "map.yaml")))
    assert "atmospheric_pressure_pa: 95000" in done.said["note", "atmosphere"]
    np.testing.assert_allclose(done.signals.pressure_pa, BAR * 1e5 + 95000.0)


@pytest.mark.parametrize("gauge", ["true", "false"])
@pytest.mark.parametrize("vented_bar", [0.0, 1.013, 1.4])
def test_a_pressure_whose_rest_is_twice_the_atmosphere_is_told_to_be_absolute(
    tmp_path, vented_bar, gauge
):
    bar = np.round(np.maximum(3.0 * np.sin(4.0 * T_S), 0.0) + vented_bar, 3)
    text = f"time: {{column: 1}}\npressure: {{column: 3, unit: bar, gauge: {gauge}}}\n"
    path = write(tmp_path, table((*HEAD[:2], "P", HEAD[3]), (T_S, VALVE_V, bar, MM)))
    done = Outcome(path, "--map", str(write(tmp_path, text, "map.yaml")))
    told = done.said.get(("warning", "gauge"), "")
    assert ("say `gauge: false`" in told) == (vented_bar == 1.013 and gauge == "true")
    refused = done.said.get(("error", "unit"), "")
    assert ("say `gauge: true` in the map" in refused) == (vented_bar == 0.0 and gauge == "false")


def test_a_map_says_the_encoding(tmp_path):
    head = ("\u6642\u9593 [s]", *HEAD[1:3], "\u4f4d\u7f6e [mm]")
    path = write(tmp_path, table(head).encode("shift_jis"))
    text = (
        "encoding: shift_jis\ntime: {column: '\u6642\u9593 [s]'}\n"
        "valve: {column: 2}\npressure: {column: 3, unit: bar, gauge: true}\n"
        "position: {column: '\u4f4d\u7f6e [mm]', unit: mm}\n"
    )
    require_good(Outcome(path, "--map", str(write(tmp_path, text, "map.yaml"))))
