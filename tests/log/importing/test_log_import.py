"""Imports of foreign measurements: exact in SI, and every doubt is reported."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat
from typer.testing import CliRunner

import pamctl.log
from pamctl.cli.app import app
from pamctl.log.importing.file_formats import read_table
from pamctl.log.importing.pipeline import resample_columns

T_S = np.arange(400) * 1e-3
VALVE_V = np.where(np.sin(20 * T_S) > 0, 1.5, -1.5)
GAUGE_PA = 2e5 + 5e4 * np.sin(10 * T_S)
POSITION_M = 0.012 + 0.004 * np.sin(10 * T_S)
ATMOSPHERE_PA = 101.3e3
GOOD = {
    "t_s": T_S,
    "valve_v": VALVE_V,
    "pressure_pa": GAUGE_PA + ATMOSPHERE_PA,
    "position_m": POSITION_M,
}


def write_csv(path: Path, columns: dict[str, Any], delimiter: str = ",") -> Path:
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    lines = [delimiter.join(columns), *(delimiter.join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


class Outcome:
    """The output of the command, and the files it left."""

    def __init__(self, source: Path, *options: str) -> None:
        self.path = source.with_suffix(".mcap")
        arguments = ["log", "import", str(source), str(self.path), "--json", *options]
        done = CliRunner().invoke(app, arguments)
        self.code, self.stderr = done.exit_code, done.stderr
        self.report = json.loads(done.stdout)
        found = self.report.get("findings", [])
        self.said = {(f["severity"], f["kind"]): f["message"] for f in found}

    @property
    def shown_map(self) -> str:
        """The map that a refusal shows, as it stands."""
        return "\n".join(line for line in self.stderr.splitlines() if line.startswith("  "))

    @property
    def signals(self) -> pamctl.log.Signals:
        assert self.code == 0, self.report
        return pamctl.log.signals(pamctl.log.read(self.path))


def changed(**columns: Any) -> dict[str, Any]:
    return {**GOOD, **columns}


def with_one(values: Any, index: int, value: float) -> Any:
    copy = np.array(values, float)
    copy[index] = value
    return copy


# Accepted files.


def test_the_standard_header_needs_no_map_and_every_number_survives_to_the_bit(tmp_path):
    done = Outcome(write_csv(tmp_path / "a.csv", GOOD))
    measured = done.signals
    for name, column in GOOD.items():
        assert np.array_equal(getattr(measured, name), column), name
    assert done.said == {}
    assert measured.force_n is None
    assert (measured.phase == pamctl.log.NO_PHASE).all()


def test_what_excel_puts_around_a_table_is_no_part_of_it(tmp_path):
    text = write_csv(tmp_path / "plain.csv", GOOD, ";").read_text().replace(".", ",")
    source = tmp_path / "excel.csv"
    framed = "sep=;\n" + text + "\n;;;\n;;;\n"
    source.write_bytes(b"\xef\xbb\xbf" + framed.replace("\n", "\r\n").encode())
    log = Outcome(source)
    assert (log.code, log.said) == (0, {})
    np.testing.assert_array_equal(log.signals.valve_v, VALVE_V)


def test_a_file_of_another_encoding_is_read_and_the_encoding_is_told(tmp_path):
    source = tmp_path / "latin.csv"
    source.write_bytes("t_s,x [µm],temp °C\n0,5000,20\n1e-3,5001,20\n".encode("cp1252"))
    done = Outcome(source)
    assert "read as Windows-1252" in done.said["note", "file"]
    assert done.signals.position_m == pytest.approx([5000e-6, 5001e-6])


def test_time_starts_at_zero_and_the_log_says_where_it_started(tmp_path):
    done = Outcome(write_csv(tmp_path / "a.csv", changed(t_s=T_S + 12.5)))
    assert done.signals.t_s == pytest.approx(T_S)
    log = pamctl.log.read(done.path)
    assert log.metadata["import"]["first_t_s"] == "12.5"
    assert log.metadata["import"]["source"] == "a.csv"


def test_an_import_of_the_same_file_gives_the_same_bytes(tmp_path):
    first = Outcome(write_csv(tmp_path / "a.csv", GOOD)).path.read_bytes()
    (tmp_path / "a.mcap").unlink()
    assert Outcome(tmp_path / "a.csv").path.read_bytes() == first


# MAT files, as Simulink and its users write them.


def structure_with_time(**signals: Any) -> dict[str, Any]:
    fields = [("values", "O"), ("label", "O")]
    each = [(values[:, None], label) for label, values in signals.items()]
    return {"time": T_S[:, None], "signals": np.array(each, fields)}


MAT_FILES = {
    "a structure with time": {
        "scope": structure_with_time(**{k: v for k, v in GOOD.items() if k != "t_s"})
    },
    "tout and a structure a signal": {
        "tout": T_S[:, None],
        **{name: structure_with_time(x=GOOD[name]) for name in list(GOOD)[1:]},
    },
    "timeseries as structs": {
        name: {"Time": T_S[:, None], "Data": GOOD[name][:, None]} for name in list(GOOD)[1:]
    },
}


@pytest.mark.parametrize("content", MAT_FILES.values(), ids=MAT_FILES)
def test_a_mat_file_is_read_as_it_was_saved(tmp_path, content, parsed_here):
    savemat(tmp_path / "a.mat", content)
    measured = Outcome(tmp_path / "a.mat").signals
    for name, column in GOOD.items():
        assert np.array_equal(getattr(measured, name), column), name


def test_columns_of_a_matrix_are_chosen_with_a_map(tmp_path, parsed_here):
    savemat(tmp_path / "a.mat", {"yout": np.c_[VALVE_V + 5.0, GAUGE_PA / 1e3, POSITION_M * 1e3]})
    (tmp_path / "map.yaml").write_text(
        "time: {rate_hz: 1000}\n"
        'valve: {column: "yout(:,1)", offset: -5.0}\n'
        'pressure: {column: "yout(:,2)", unit: kPa, gauge: true}\n'
        'position: {column: "yout(:,3)", unit: mm, gain: -1.0, noise: 0.05}\n'
    )
    done = Outcome(tmp_path / "a.mat", "--map", str(tmp_path / "map.yaml"))
    stated = json.loads(pamctl.log.read(done.path).metadata["import"]["noise"])
    assert stated == {"position_m": pytest.approx(5e-5)}
    measured = done.signals
    assert measured.t_s == pytest.approx(T_S)
    assert measured.valve_v == pytest.approx(VALVE_V)
    assert measured.pressure_pa == pytest.approx(GOOD["pressure_pa"])
    assert measured.position_m == pytest.approx(-POSITION_M)


def test_a_mat_file_that_crashes_its_parser_is_refused(tmp_path):
    """Found by fuzzing: scipy's parser ends with a bus error or a segmentation fault."""
    shutil.copy(Path(__file__).parent / "damaged" / "crashes_the_parser.mat", tmp_path / "a.mat")
    done = Outcome(tmp_path / "a.mat")
    assert done.code == 65
    assert "MAT file" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["none.mat", "none.csv"])
def test_a_file_that_is_not_there_is_named_with_its_path(tmp_path, name):
    done = Outcome(tmp_path / name)
    assert done.code == 65
    assert f"cannot read {tmp_path / name}: No such file or directory" in done.stderr


# Errors that stop an import.


@pytest.mark.parametrize(
    ("columns", "kind", "told"),
    [
        (changed(t_s=with_one(T_S, 10, np.nan)), "missing", "row 12"),
        (changed(t_s=with_one(T_S, 10, 0.005)), "backwards", "row 12 (0.005 s); where"),
        (changed(t_s=with_one(T_S, 10, T_S[9])), "duplicated", "row 12"),
        (changed(t_s=T_S * 1e3), "unit", "time in ms"),
        (changed(pressure_pa=GAUGE_PA / 1e3), "unit", "pressure_kpa"),
        (changed(pressure_pa=GAUGE_PA - 1.8e5), "unit", "gauge"),
        (changed(pressure_pa=GAUGE_PA / 1e5), "unit", "bar"),
        (changed(position_m=POSITION_M * 1e3), "unit", "position_mm"),
        (changed(valve_v=VALVE_V + 5.0), "unit", "0..10 V"),
        (changed(valve_v=np.where(VALVE_V > 0, 5.0, 0.0)), "unit", "which level fills"),
        (changed(position_m=np.full_like(T_S, np.nan)), "empty", "has no values"),
        ({name: column[:1] for name, column in GOOD.items()}, "short", "there is 1 row"),
    ],
)
def test_what_cannot_be_believed_stops_the_import_with_its_rows(tmp_path, columns, kind, told):
    done = Outcome(write_csv(tmp_path / "a.csv", columns))
    assert done.code == 65
    assert told in done.said["error", kind]
    assert not done.report["written"]
    assert not done.path.exists()


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1e300, "the time (t_s) goes on for more than 4.61e+09 s"),
        (1e-300, "the time (t_s) has another unit: rows are 1e-303 s apart"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_times_that_a_log_cannot_hold_stop_the_import_whatever_is_accepted(tmp_path, factor, told):
    path = write_csv(tmp_path / "a.csv", changed(t_s=T_S * factor))
    done = Outcome(path, "--accept-units")
    assert done.code == 65
    assert told in done.said["error", "time"]
    assert not done.path.exists()


@pytest.mark.parametrize("years", [1, 100])
def test_the_log_of_a_slow_and_long_measurement_is_whole(tmp_path, years):
    path = write_csv(tmp_path / "a.csv", changed(t_s=T_S / T_S[-1] * years * 3.15e7))
    done = Outcome(path, "--accept-units")
    assert done.code == 0
    assert CliRunner().invoke(app, ["log", "check", str(done.path)]).exit_code == 0


@pytest.mark.filterwarnings("error")
def test_a_number_that_its_unit_carries_beyond_all_numbers_stops_the_import(tmp_path):
    columns = {"t_s": T_S, "pressure_bar": with_one(GAUGE_PA / 1e5, 10, 1e306)}
    done = Outcome(write_csv(tmp_path / "a.csv", columns), "--accept-units")
    assert done.code == 65
    assert "pressure_bar is 1e+306 bar at row 12" in done.stderr
    assert not done.path.exists()


def test_a_unit_that_looks_wrong_can_be_accepted_and_the_log_remembers(tmp_path):
    path = write_csv(tmp_path / "a.csv", changed(position_m=POSITION_M * 1e3))
    done = Outcome(path, "--accept-units")
    assert np.array_equal(done.signals.position_m, POSITION_M * 1e3)
    assert "position_mm" in pamctl.log.read(done.path).metadata["import"]["report"]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "is empty"),
        ("0.0,1.0\n0.1,2.0\n", "the columns are called 1, 2; say which with --map"),
        ("t_s,position_m\n0.0,0.01\n0.001,abc\n", ":3: position_m is 'abc'"),
        ("t_s,position_m\n0.0,0.01\n0.001\n0.002,0.01\n", ":3: the line has 1 cell"),
        ("t_s,t_s\n0.0,0.01\n0.1,0.02\n", "may each be t_s"),
        ("row,position_m\n0.0,0.01\n1,0.02\n", "no column is called t_s"),
        ("t_s,position_m,position_mm\n0,0.01,10\n0.001,0.01,10\n", "may each be position_m"),
    ],
)
def test_a_table_that_is_none_is_refused_with_its_line(tmp_path, text, told):
    (tmp_path / "a.csv").write_text(text)
    done = Outcome(tmp_path / "a.csv")
    assert done.code == 65
    assert told in done.stderr


@pytest.mark.parametrize(
    ("text", "code", "told"),
    [
        ("position: {column: x, unit: mm, offest: 1}", 78, "map.yaml:2:"),
        ("position: {column: x, unit: mm, offest: 1}", 78, "did you mean 'offset'"),
        ("position: {column: x, unit: deg}", 78, "the radius of the pulley or lever in m times"),
        ("valve: {column: valve_v, unit: mA}", 78, "`unit: V, gain: 0.625, offset: -7.5` for 4 to"),
        ("force: {column: valve_v, unit: A}", 78, "where G x column + O is in N"),
        ("position: {column: positon_m, unit: m}", 65, "did you mean position_m?"),
        ("valve: {column: valve_v}", 65, "there is neither pressure nor position"),
    ],
)
def test_a_slip_in_a_map_is_told_with_its_line_or_the_nearest_word(tmp_path, text, code, told):
    write_csv(tmp_path / "a.csv", GOOD)
    (tmp_path / "map.yaml").write_text(f"time: {{column: t_s}}\n{text}\n")
    done = Outcome(tmp_path / "a.csv", "--map", str(tmp_path / "map.yaml"))
    assert done.code == code
    assert told in done.stderr + str(done.report)


def test_a_map_is_a_configuration_file_that_is_known_by_its_keys(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "time: {column: t, unit: ms}\npressure: {column: p, unit: kPa, gauge: true}\n"
    )
    done = CliRunner().invoke(app, ["config", "check", str(tmp_path / "mine.yaml")])
    assert (done.exit_code, done.stdout.rsplit(": ", 1)[1]) == (0, "ok (import-map)\n")


def test_an_import_never_overwrites(tmp_path):
    write_csv(tmp_path / "a.csv", GOOD)
    (tmp_path / "a.mcap").write_bytes(b"precious")
    assert Outcome(tmp_path / "a.csv").code == 2
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"


# Warnings.


@pytest.mark.parametrize(
    ("columns", "kind", "told"),
    [
        (changed(t_s=np.where(np.arange(400) < 50, T_S, T_S + 0.02)), "gap", "before: row 52"),
        (changed(t_s=T_S + 2e-4 * np.sin(T_S * 997)), "jitter", "--resample"),
        (changed(position_m=with_one(POSITION_M, 7, np.nan)), "missing", "row 9"),
        (changed(position_m=-POSITION_M), "sign", "gain: -1"),
        (changed(valve_v=np.full_like(T_S, 1.0)), "constant", "valve_v is 1 V throughout"),
        ({"t_s": T_S, "position_m": POSITION_M}, "columns", "no pressure_pa, valve_v"),
    ],
)
def test_what_a_user_should_know_is_a_warning_and_goes_into_the_log(tmp_path, columns, kind, told):
    done = Outcome(write_csv(tmp_path / "a.csv", columns))
    assert done.code == 0
    assert told in done.said["warning", kind]
    report = json.loads(pamctl.log.read(done.path).metadata["import"]["report"])
    assert kind in {finding["kind"] for finding in report}
    assert CliRunner().invoke(app, ["log", "check", str(done.path)]).exit_code == 0


# Resampling.


@pytest.mark.parametrize(
    ("rate", "told"),
    [("1e12", "is it in Hz?"), ("0.001", "--resample 0.001 leaves 1 tick of 0.399 s")],
)
def test_a_rate_of_too_many_or_too_few_ticks_is_refused_and_nothing_is_written(
    tmp_path, rate, told
):
    done = Outcome(write_csv(tmp_path / "a.csv", GOOD), "--resample", rate)
    assert done.code == 65
    assert told in done.stderr
    assert not done.path.exists()


def test_resampling_is_a_straight_line_for_what_was_measured_and_a_hold_for_the_command(tmp_path):
    t_s = np.sort(np.random.default_rng(1).uniform(0, 1, 1000))
    columns = {"t_s": t_s, "valve_v": np.where(t_s > 0.5, 2.0, -1.0), "position_m": 0.01 * t_s}
    path = write_csv(tmp_path / "a.csv", columns)
    measured = Outcome(path, "--resample", "400").signals
    kept = measured.t_s + t_s[0]
    assert measured.position_m == pytest.approx(0.01 * kept, rel=1e-9)
    assert set(measured.valve_v) == {2.0, -1.0}
    assert np.array_equal(measured.valve_v > 0, kept >= t_s[t_s > 0.5][0])


def test_resampling_makes_nothing_up_within_a_gap(tmp_path):
    t_s = np.concatenate([np.arange(100), np.arange(150, 250)]) * 1e-3
    path = write_csv(tmp_path / "a.csv", {"t_s": t_s, "position_m": 0.01 + 0.1 * t_s})
    measured = Outcome(path, "--resample", "2000").signals
    assert not ((measured.t_s > 0.0995) & (measured.t_s < 0.1495)).any()
    assert measured.missed.max() == pytest.approx(101, abs=1)


@given(st.integers(2, 300), st.floats(10.0, 5000.0), st.floats(0.1, 20.0))
def test_a_resampled_time_is_an_even_grid_within_what_was_measured(rows, rate_hz, ratio):
    t_s = np.arange(rows) / (rate_hz * ratio)
    kept, values = resample_columns(t_s, {"position_m": t_s}, rate_hz)
    assert kept[0] == t_s[0]
    assert kept[-1] <= t_s[-1] * (1 + 1e-9) + 1e-12
    steps = np.diff(kept) * rate_hz
    assert steps == pytest.approx(np.rint(steps), abs=1e-6)
    assert values["position_m"] == pytest.approx(np.minimum(kept, t_s[-1]))


def test_a_matrix_of_no_rows_and_a_thousand_million_columns_is_left_out(tmp_path, parsed_here):
    """Found by fuzzing: it took all memory."""
    name = tmp_path / "a.mat"
    t_s = T_S[:20]
    savemat(name, {"t_s": t_s, "nothing": np.zeros((0, 3))}, format="4")
    content, size = name.read_bytes(), struct.pack("<ii", 0, 3)
    assert content.count(size) == 1
    name.write_bytes(content.replace(size, struct.pack("<ii", 0, 1 << 30)))
    assert [column.name for column in read_table(name).columns] == ["t_s"]
