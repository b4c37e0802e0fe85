"""Files as labs write them, each made by another program than ours: one command each, no map.

Every file holds the same measurement. What is read back must agree with it to the digits that the
file has.
"""

import datetime as dt
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import h5py
import numpy as np
import openpyxl
import pytest
from nptdms import ChannelObject, RootObject, TdmsWriter
from scipy.io import savemat
from test_log_import import ATMOSPHERE_PA, Outcome

import pamctl.log
from pamctl.log.importing import file_formats
from pamctl.log.importing.column_map import ForceMap, PositionMap, PressureMap, TimeMap, ValveMap
from pamctl.log.importing.headers import find_units
from pamctl.log.importing.measured_table import ImportRefused

T_S = np.arange(300) * 2e-3
COMMAND_V = np.where(np.sin(20 * T_S) > 0, 1.5, -1.25)
GAUGE_BAR = np.round(1.2 - 1.2 * np.cos(12 * T_S), 4)
POSITION_MM = np.round(6.0 - 6.0 * np.cos(12 * T_S), 4)
ABSOLUTE_KPA = GAUGE_BAR * 100.0 + ATMOSPHERE_PA / 1e3
NOON = dt.datetime(2026, 5, 4, 12, 0, 0)


def times() -> list[dt.datetime]:
    return [NOON + dt.timedelta(milliseconds=2 * k) for k in range(len(T_S))]


def write_text(path: Path, head: str, rows: list[list[str]], apart: str, **how: Any) -> Path:
    text = head + "".join(apart.join(row) + "\n" for row in rows)
    path.write_text(text, **how)
    return path


def columns(*values: Any) -> list[list[str]]:
    return [[cell if isinstance(cell, str) else f"{cell:.6g}" for cell in row] for row in zip(*values, strict=True)]  # fmt: skip  # noqa: E501


# The files.


def clock_csv_over_midnight(folder: Path) -> Path:
    late = [time + dt.timedelta(hours=11, minutes=59, seconds=59.9) for time in times()]
    stamps = [time.strftime("%H:%M:%S.%f")[:-3] for time in late]
    head = "Date,Time,Command (V),Muscle pressure (kPa abs),Displacement (mm)\n"
    rows = columns(["5/4/2026"] * len(T_S), stamps, COMMAND_V, ABSOLUTE_KPA, POSITION_MM)
    return write_text(folder / "clock.csv", head, rows, ",")


def excel_with_units(folder: Path) -> Path:
    book = openpyxl.Workbook()
    book.create_sheet("Notes").append(["Operator", "Kim"])
    sheet = book.worksheets[0]
    sheet.append(["Run 12"])
    sheet.append([])
    sheet.append(["Time", "Valve command", "Gauge pressure", "Displacement"])
    sheet.append(["[s]", "[V]", "[bar]", "[mm]"])
    for row in zip(T_S, COMMAND_V, GAUGE_BAR, POSITION_MM, strict=True):
        sheet.append([float(cell) for cell in row])
    book.save(folder / "units.xlsx")
    return folder / "units.xlsx"


def excel_with_clock(folder: Path) -> Path:
    book = openpyxl.Workbook()
    sheet = book.worksheets[0]
    sheet.append(["Time", "Command [V]", "Pressure [kPa abs]", "Position [mm]", "Set point [mm]"])
    for time, *row in zip(times(), COMMAND_V, ABSOLUTE_KPA, POSITION_MM, POSITION_MM, strict=True):
        sheet.append([time, *map(float, row)])
    book.save(folder / "clock.xlsx")
    return folder / "clock.xlsx"


def tdms_waveforms(folder: Path) -> Path:
    with TdmsWriter(folder / "wave.tdms") as writer:
        for name, unit, values in (
            ("Valve command", "V", COMMAND_V),
            ("Pressure", "bar", GAUGE_BAR),
            ("Position", "mm", POSITION_MM),
        ):
            properties = {"wf_increment": 2e-3, "wf_start_offset": 0.0, "unit_string": unit}
            writer.write_segment([ChannelObject("Measured Data", name, values, properties)])
    return folder / "wave.tdms"


def tdms_with_time_stamps(folder: Path) -> Path:
    stamps = np.array(times(), "datetime64[us]")
    with TdmsWriter(folder / "stamps.tdms") as writer:
        objects = [
            RootObject({"author": "Kim"}),
            ChannelObject("Log", "Time", stamps),
            ChannelObject("Log", "Command [V]", COMMAND_V),
            ChannelObject("Log", "Pressure [kPa abs]", ABSOLUTE_KPA),
            ChannelObject("Log", "Position [mm]", POSITION_MM),
            ChannelObject("Set points", "Position [mm] set", POSITION_MM),
        ]
        writer.write_segment(objects)
    return folder / "stamps.tdms"


LVM_HEAD = """\
LabVIEW Measurement
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t{mark}
Multi_Headings\tNo
X_Columns\t{columns}
Time_Pref\tRelative
Operator\tKim
Date\t2026/05/04
Time\t12:00:00,1234567
***End_of_Header***

Channels\t3
Samples\t300\t300\t300
Date\t2026/05/04\t2026/05/04\t2026/05/04
Time\t12:00:00,1\t12:00:00,1\t12:00:00,1
Y_Unit_Label\tV\tbar\tmm
X_Dimension\tTime\tTime\tTime
X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t0.0000000000000000E+0
Delta_X\t0.002000\t0.002000\t0.002000
***End_of_Header***
X_Value\tValve command\tPressure\tPosition\tComment
"""


def write_lvm(path: Path, rows: list[list[str]], mark: str, times_are: str) -> Path:
    head = LVM_HEAD.format(mark=mark, columns=times_are)
    head = head.replace("0.0000", f"0{mark}0000").replace("0.002000", f"0{mark}002000")
    return write_text(path, head, rows, "\t", newline="\r\n")


def lvm_with_time(folder: Path) -> Path:
    rows = columns(T_S, COMMAND_V, GAUGE_BAR, POSITION_MM)
    return write_lvm(folder / "one.lvm", rows, ".", "One")


def lvm_with_commas_and_no_time(folder: Path) -> Path:
    rows = columns([""] * len(T_S), COMMAND_V, GAUGE_BAR, POSITION_MM)
    rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    return write_lvm(folder / "none.lvm", rows, ",", "No")


def stamp_as_matlab(path: Path) -> Path:
    """Put MATLAB's own 512 bytes before the HDF5 file, which h5py left free."""
    head = b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(116) + bytes(8) + struct.pack("<H", 512)
    with path.open("r+b") as file:
        file.write(head + b"IM")
    return path


def put(group: Any, name: str, values: Any, kind: bytes = b"double") -> Any:
    made = group.create_dataset(name, data=values)
    made.attrs["MATLAB_class"] = np.bytes_(kind)
    return made


def matlab_73_arrays(folder: Path) -> Path:
    path = folder / "arrays.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (
            ("tout", T_S), ("valve_v", COMMAND_V), ("pressure_gauge_bar", GAUGE_BAR),
            ("position_mm", POSITION_MM),
        ):  # fmt: skip
            put(file, name, values[None, :])
        put(file, "title", np.array([[ord(letter)] for letter in "Run 7"], np.uint16), b"char")
    return stamp_as_matlab(path)


def matlab_73_scope(folder: Path) -> Path:
    path = folder / "scope73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        scope, store = file.create_group("scope"), file.create_group("#refs#")
        scope.attrs["MATLAB_class"] = np.bytes_(b"struct")
        put(scope, "time", T_S[None, :])
        signals = scope.create_group("signals")
        signals.attrs["MATLAB_class"] = np.bytes_(b"struct")
        parts: dict[str, list[Any]] = {"values": [], "label": []}
        for index, (label, values) in enumerate(
            (("u [V]", COMMAND_V), ("Pressure [bar]", GAUGE_BAR), ("Position [mm]", POSITION_MM))
        ):
            parts["values"].append(put(store, f"v{index}", values[None, :]).ref)
            letters = np.array([[ord(letter)] for letter in label], np.uint16)
            parts["label"].append(put(store, f"l{index}", letters, b"char").ref)
        for name, references in parts.items():
            signals.create_dataset(name, data=np.array(references, h5py.ref_dtype)[:, None])
    return stamp_as_matlab(path)


def test_a_matrix_and_signals_without_labels_are_called_by_their_numbers(tmp_path, parsed_here):
    with h5py.File(tmp_path / "new.mat", "w", userblock_size=512) as file:
        put(file, "yout", np.arange(6.0).reshape(2, 3))  # of three rows for MATLAB
    new = file_formats.read_table(stamp_as_matlab(tmp_path / "new.mat"))
    assert {c.name: c.values.tolist() for c in new.columns} == {
        "yout(:,1)": [0.0, 1.0, 2.0], "yout(:,2)": [3.0, 4.0, 5.0],
    }  # fmt: skip
    signals = np.array([[(T_S,), (2.0 * T_S,)]], [("values", object)])
    savemat(tmp_path / "old.mat", {"scope": {"time": T_S, "signals": signals}})
    old = file_formats.read_table(tmp_path / "old.mat")
    assert [column.name for column in old.columns] == ["scope.time", "scope(1)", "scope(2)"]


WRITERS: tuple[Callable[[Path], Path], ...] = (
    clock_csv_over_midnight,
    excel_with_units,
    excel_with_clock,
    tdms_waveforms,
    tdms_with_time_stamps,
    lvm_with_time,
    lvm_with_commas_and_no_time,
    matlab_73_arrays,
    matlab_73_scope,
)


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__)
def test_a_lab_file_is_imported_by_its_header_alone(tmp_path, write, parsed_here):
    done = Outcome(write(tmp_path))
    assert done.code == 0, done.stderr
    measured = done.signals
    np.testing.assert_allclose(measured.t_s, T_S, atol=1e-9)
    np.testing.assert_array_equal(measured.valve_v, COMMAND_V)
    np.testing.assert_allclose(measured.pressure_pa, GAUGE_BAR * 1e5 + ATMOSPHERE_PA, atol=1.0)
    np.testing.assert_allclose(measured.position_m, POSITION_MM * 1e-3, atol=1e-9)
    assert {kind for severity, kind in done.said if severity == "error"} == set()


@pytest.mark.parametrize(
    ("part", "quantity"),
    [(TimeMap, "t_s"), (ValveMap, "valve_v"), (PressureMap, "pressure_pa"),
     (PositionMap, "position_m"), (ForceMap, "force_n")],
)  # fmt: skip
def test_a_map_takes_the_units_of_the_one_table(part, quantity):
    assert get_args(part.model_fields["unit"].annotation) == tuple(find_units(quantity))


# Headers that leave a doubt.


def import_columns(folder: Path, **named: Any) -> Outcome:
    head = ",".join(f'"{name}"' for name in named) + "\n"
    return Outcome(write_text(folder / "a.csv", head, columns(*named.values()), ","))


TIME = {"Time [s]": T_S}


@pytest.mark.parametrize(
    ("named", "told"),
    [
        (
            {"P1 [bar]": GAUGE_BAR, "P2 [bar]": GAUGE_BAR},
            "# pressure: {column: 'P2 [bar]', unit: bar, gauge: true}  # or gauge: false",
        ),
        ({"Pressure [bar]": GAUGE_BAR + 1.5}, "'Pressure [bar]' may be gauge or absolute"),
        (
            {"Hose pressure [bar]": GAUGE_BAR, "Line pressure [bar]": GAUGE_BAR},
            "may be pressure_pa, or something else",
        ),
        ({"Valve position [mm]": POSITION_MM}, "position: {column: 'Valve position [mm]'"),
        ({"Position [mm]": POSITION_MM, "x [mm]": POSITION_MM}, "may each be position_m"),
    ],
)
def test_a_header_that_leaves_a_doubt_is_refused_with_the_map_to_write(tmp_path, named, told):
    done = import_columns(tmp_path, **TIME, **named)
    assert done.code == 65
    assert told in done.stderr
    assert "--map FILE" in done.stderr
    assert "time: {column: 'Time [s]', unit: s}" in done.stderr
    assert not done.path.exists()


def test_an_unnamed_sense_of_a_pressure_is_told_and_kept_in_the_log(tmp_path):
    done = import_columns(tmp_path, **TIME, **{"Pressure [bar]": ABSOLUTE_KPA / 100})
    assert "taken as absolute, as it falls to" in done.said["warning", "gauge"]
    assert "taken as absolute" in pamctl.log.read(done.path).metadata["import"]["report"]
    np.testing.assert_allclose(done.signals.pressure_pa, ABSOLUTE_KPA * 1e3, atol=10.0)


# Hostile files.


def refuse(path: Path, content: bytes | None = None) -> str:
    if content is not None:
        path.write_bytes(content)
    done = Outcome(path)
    assert done.code == 65, done.report
    assert "Traceback" not in done.stderr
    assert str(path) in done.stderr
    assert not done.path.exists()
    return str(done.stderr)


@pytest.mark.parametrize(
    ("write", "told"),
    [
        (tdms_waveforms, "the file is damaged"),
        (excel_with_units, "save it again"),
        (matlab_73_arrays, "save(name, ..., '-v7')"),
    ],
)
def test_a_truncated_file_is_refused_with_what_to_do(tmp_path, write, told, parsed_here):
    path = write(tmp_path)
    content = path.read_bytes()
    cut = path.with_name(f"cut{path.suffix}")
    cut.write_bytes(content[: int(len(content) * 0.6)])
    done = Outcome(cut)
    assert "Traceback" not in done.stderr
    assert (done.code, told in done.stderr) == (65, True)


def test_what_labview_wrote_before_it_ended_early_is_kept_with_a_warning(tmp_path, parsed_here):
    path = tmp_path / "a.tdms"
    with TdmsWriter(path) as writer:
        properties = {"wf_increment": 2e-3, "unit_string": "mm"}
        writer.write_segment([ChannelObject("Log", "Position", POSITION_MM, properties)])
    path.write_bytes(path.read_bytes()[:-800])
    done = Outcome(path)
    assert "the file is damaged" in done.said["warning", "file"]
    np.testing.assert_allclose(done.signals.position_m, POSITION_MM[:200] * 1e-3)


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, parsed_here):
    path = tmp_path / "bomb.xlsx"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/worksheets/sheet1.xml", b"0" * 12345)
    claimed = path.read_bytes().replace(*(struct.pack("<I", n) for n in (12345, 0x7FFFFFFF)))
    assert "too large: 2.0 GB unpacked" in refuse(path, claimed)


def test_an_array_that_claims_all_memory_is_refused(tmp_path, parsed_here):
    path = tmp_path / "claim.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("position_m", (1 << 40,), float, chunks=(1 << 16,), compression="gzip")
    assert "8192.0 GB" in refuse(stamp_as_matlab(path))


def test_a_huge_file_is_refused_by_its_size(tmp_path):
    path = tmp_path / "huge.tdms"
    with path.open("wb") as file:
        file.truncate(file_formats.LARGEST_BYTES + 1)
    assert "the limit is 4 GB" in refuse(path)


def test_a_line_without_an_end_is_refused(tmp_path):
    assert ":2: the line is longer" in refuse(tmp_path / "a.csv", b"t_s,x\n" + b"1" * 200_000)


def test_a_missing_package_is_one_line_with_the_command(tmp_path, monkeypatch):
    blocked = tmp_path / "blocked"
    blocked.mkdir()
    for name in ("nptdms", "h5py"):
        (blocked / f"{name}.py").write_text(f"raise ModuleNotFoundError(name={name!r})\n")
    files = tdms_waveforms(tmp_path), matlab_73_arrays(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{blocked}:{Path(pamctl.__file__).parents[1]}")
    for path in files:
        package = "nptdms" if path.suffix == ".tdms" else "h5py"
        assert f"-m pip install {package}" in refuse(path)


def test_sheets_that_both_hold_numbers_are_refused_by_name(tmp_path, parsed_here):
    book = openpyxl.load_workbook(excel_with_units(tmp_path))
    book.copy_worksheet(book.worksheets[0]).title = "Second"
    book.save(tmp_path / "two.xlsx")
    assert "there are Sheet, Second" in refuse(tmp_path / "two.xlsx")


def test_waveforms_of_different_times_are_refused(tmp_path, parsed_here):
    with TdmsWriter(tmp_path / "a.tdms") as writer:
        for name, unit, step_s in (("Pressure", "bar", 1e-3), ("Position", "mm", 2e-3)):
            properties = {"wf_increment": step_s, "unit_string": unit}
            writer.write_segment([ChannelObject("G", name, GAUGE_BAR, properties)])
    done = Outcome(tmp_path / "a.tdms")
    assert done.code == 65
    assert "the waveforms differ" in done.stderr


def lvm_segment(start: str, *, names: str = "A\tB", units: str = "V\tmm") -> str:
    """Return five rows of two channels, whose time begins at zero."""
    head = {"Channels": "2", "Date": "2026/05/04\t2026/05/04", "Time": f"{start}\t{start}",
            "Y_Unit_Label": units, "X_Dimension": "Time\tTime", "X0": "0\t0",
            "Delta_X": "0.002\t0.002"}  # fmt: skip
    lines = [f"{key}\t{value}" for key, value in head.items()]
    rows = [f"{0.002 * k:g}\t{k}\t{k * k}" for k in range(5)]
    return "\n".join([*lines, "***End_of_Header***", f"X_Value\t{names}\tComment", *rows, "", ""])


def write_lvm_segments(path: Path, *segments: str) -> Path:
    head = LVM_HEAD.format(mark=".", columns="One").split("\n\n")[0]
    path.write_text("\n\n".join([head, "".join(segments)]).rstrip("\n") + "\n")
    return path


def test_segments_of_an_lvm_file_follow_one_another_by_their_starts(tmp_path, parsed_here):
    first, second = lvm_segment("12:00:00,1"), lvm_segment("12:00:03,1")
    path = write_lvm_segments(tmp_path / "two.lvm", first, second)
    table = file_formats.read_table(path)
    assert [(column.name, column.unit) for column in table.columns] == [
        ("time_s", ""), ("A", "V"), ("B", "mm"),
    ]  # fmt: skip
    even = 0.002 * np.arange(5)
    np.testing.assert_allclose(table.columns[0].values, [*even, *(3.0 + even)], atol=1e-6)


@pytest.mark.parametrize(
    ("others", "told"),
    [
        ({"names": "A\tC"}, "its segments have different channels"),
        ({"units": "V\tm"}, "a unit changes between segments"),
        ({"names": "A\tA"}, "more than one channel A"),
    ],
)
def test_segments_that_do_not_fit_together_are_refused(tmp_path, parsed_here, others, told):
    first, second = lvm_segment("12:00:00,1"), lvm_segment("12:00:03,1", **others)
    with pytest.raises(ImportRefused, match=told):
        file_formats.read_table(write_lvm_segments(tmp_path / "two.lvm", first, second))
