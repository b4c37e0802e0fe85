"""What a refused import advises helps the one who follows it: stumbles of new users, one each."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_log_import import GOOD, POSITION_M, T_S, VALVE_V, Outcome, changed, with_one, write_csv

MAP = """\
time: {{column: 'Time [ms]', unit: {unit}}}
pressure: {{column: pressure_pa, unit: Pa, gauge: false}}
position: {{column: position_m, unit: m}}
"""


def everything(done: Outcome) -> str:
    """Return all that an import says, in its words and in its document."""
    return str(done.stderr) + "\n".join(map(str, done.report.values()))


def import_names(path: Path, head: str, *columns: Any) -> Outcome:
    """Import a table of these names; a comma parts them."""
    return Outcome(write_csv(path, dict(zip(head.split(","), columns, strict=True))))


def follow(done: Outcome, source: Path) -> Outcome:
    """Import again, with the map that the refusal shows."""
    map_path = source.with_name("map.yaml")
    map_path.write_text(done.report["map_text"])
    return Outcome(source, "--map", str(map_path))


def follow_and_check(refused: Outcome, source: Path) -> None:
    np.testing.assert_allclose(follow(refused, source).signals.t_s, T_S, atol=1e-9)


@pytest.mark.parametrize("unit", ["s", "min"])
def test_milliseconds_that_a_map_takes_for_seconds_get_a_map_that_does_not(tmp_path, unit):
    columns = {"Time [ms]": T_S * 1e3, **{k: v for k, v in GOOD.items() if k != "t_s"}}
    source = write_csv(tmp_path / "a.csv", columns)
    refused = import_with(source, MAP.format(unit=unit))
    assert "is this ms, as the column's name says?" in refused.said["error", "unit"]
    follow_and_check(refused, source)


@pytest.mark.parametrize("time", [T_S[9], np.nan])
def test_a_time_that_is_missing_or_there_twice_gets_a_map_that_counts_the_rows(tmp_path, time):
    source = write_csv(tmp_path / "a.csv", changed(t_s=with_one(T_S, 10, time)))
    refused = Outcome(source)
    assert "`time: {rate_hz: RATE}` in the map if they are even" in everything(refused)
    follow_and_check(refused, source)


WAVE = np.sin(9.0 * T_S)
BAR = 2.0 + WAVE
SAID: dict[str, tuple[dict[str, Any], list[str], list[str]]] = {
    "a long axis in metres may be accepted": (
        changed(position_m=POSITION_M * 100.0), ["--accept-units` takes it"], []),
    "a record that is there twice gets no rate that would join its copies": (
        {name: np.tile(column, 2) for name, column in GOOD.items()},
        ["keep it once"], ["time: {rate_hz"]),
    "a map that changes nothing says so": (
        changed(pressure_pa=8e6 + T_S),
        ["is it air? pamctl models no oil", "# as it was read: change what is wrong"], []),
    "a pressure in the place of a command gets no advice of an offset": (
        changed(valve_v=40.0 + 36.0 * WAVE),
        ["or another column is the command"], ["offset: -5.0"]),
    "a displacement in the place of a pressure is not called a gauge one": (
        {"t_s": T_S, "valve_v": VALVE_V, "p [bar abs]": 38.0 + 38.03 * WAVE},
        ["above 20 bar"], ["gauge pressure?"]),
    "a word that rules a column out is said and its unit kept in the map": (
        {"t_s": T_S, "Tank pressure (psig)": 40.0 + T_S},
        ["'Tank pressure (psig)' is left out for the word 'tank' in it",
         "# pressure: {column: 'Tank pressure (psig)', unit: psi, gauge: true}"],
        ["# position: {column: 'Tank"]),
    "angles of joints are shown as positions and torques are not": (
        {"t [s]": T_S, "tau1 [Nm]": WAVE, "q1 [deg]": 30 * BAR, "q2 [deg]": 30 * BAR},
        ["# position: {column: 'q1 [deg]'", "# position: {column: 'q2 [deg]'", "# an angle"],
        ["position: {column: 'tau1"]),
    "a map that mends an error names what nothing is read from too": (
        {"t_s": T_S, "Valve [V]": 5.0 + VALVE_V, "Position [mm]": 1e3 * POSITION_M, "Sonda": T_S},
        ["offset: -5.0", "# pressure: {column: 'Sonda', unit: kPa, gauge: true}"], []),
    "a table of neither air nor motion is offered no map": (
        {"Temps (s)": T_S, "Puissance (W)": 100.0 + T_S, "Température (°C)": 20.0 + T_S},
        ["pamctl describes air and what it moves, and W, °C measure neither"],
        ["# valve", "# force", "--map FILE", "time: {"]),
    "a lonely time is offered no remark on what pamctl describes": (
        {"t_s": T_S}, [], ["pamctl describes"]),
}  # fmt: skip


@pytest.mark.parametrize(("columns", "told", "never"), SAID.values(), ids=SAID)
def test_a_refusal_says_what_helps_and_nothing_that_misleads(tmp_path, columns, told, never):
    refused = Outcome(write_csv(tmp_path / "a.csv", columns))
    assert refused.code == 65
    assert [text for text in told if text not in everything(refused)] == []
    assert [text for text in never if text in everything(refused)] == []


def test_an_lvm_head_above_another_table_is_refused_with_what_to_save(tmp_path):
    head = "LabVIEW Measurement\nWriter_Version\t2\nSeparator\tTab\n***End_of_Header***\n\n"
    rows = "".join(f"{0.001 * k:g}\t{k % 7}\n" for k in range(50))
    whole = "Time [s]\tPosition [mm]\n" + rows
    (tmp_path / "a.lvm").write_text(f"{head}Channels\t2\n***End_of_Header***\n{whole}")
    refused = Outcome(tmp_path / "a.lvm")
    assert "no line of names begins with X_Value; save what is below its head" in refused.stderr


LVM = """\
LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t.
Multi_Headings\tNo
X_Columns\tOne
***End_of_Header***\t
\t
Channels\t3
Samples\t{stated}\t{stated}\t{stated}
Y_Unit_Label\tVolts\tpsig\tin
X_Dimension\tTime\tTime\tTime
***End_of_Header***
X_Value\tValve AO\tMuscle Press\tStroke\tComment
"""
ROWS = [f"{0.001 * k:g}\t{5 + k % 5}\t{k % 7}\t{0.1 * (k % 7):g}" for k in range(400)]
LVM_MAP = """\
time: {{column: time_s, unit: s}}
valve: {{column: Valve AO, unit: V, offset: -5.0}}
pressure: {{column: {pressure}}}
position: {{column: {position}}}
"""


def write_lvm(path: Path, rows: list[str] = ROWS, stated: int = len(ROWS)) -> Path:
    """Write a file of LabVIEW whose head states so many samples."""
    path.write_text(LVM.format(stated=stated) + "\n".join(rows))
    return path


def import_with(source: Path, text: str, *more: str) -> Outcome:
    """Import with a map of this text."""
    map_path = source.with_name("map.yaml")
    map_path.write_text(text)
    return Outcome(source, "--map", str(map_path), *more)


def test_a_unit_asks_for_a_missing_pressure_whatever_its_name_is(tmp_path, parsed_here):
    source = write_lvm(tmp_path / "a.lvm")
    shown = Outcome(source).stderr.split("such as:\n")[1]
    assert "  pressure: {column: 'Muscle Press', unit: psi, gauge: true}" in shown
    assert "other columns" not in shown
    done = import_with(source, shown.split("A map says")[0].replace("  ", ""))
    np.testing.assert_allclose(done.signals.pressure_pa[3], 101300.0 + 3 * 6894.757)


def test_a_map_reads_a_unit_as_a_header_has_it(tmp_path, parsed_here):
    source = write_lvm(tmp_path / "a.lvm")
    text = LVM_MAP.format(pressure="Muscle Press, unit: psig", position="Stroke, unit: inches")
    done = import_with(source, text)
    np.testing.assert_allclose(done.signals.pressure_pa[3], 101300.0 + 3 * 6894.757)
    np.testing.assert_allclose(done.signals.position_m[3], 0.3 * 0.0254)
    refused = import_with(source, text.replace("psig", "psig, gauge: false"))
    assert "unit: psig contradicts gauge: False" in refused.stderr


@pytest.mark.parametrize("unit", ["in", "mm", "mm, gain: -1"])
def test_columns_that_a_map_exchanges_are_refused_by_the_units_of_the_file(
    tmp_path, unit, parsed_here
):
    source = write_lvm(tmp_path / "a.lvm")
    text = LVM_MAP.format(
        pressure="Stroke, unit: psi, gauge: true", position=f"Muscle Press, unit: {unit}"
    )
    refused = import_with(source, text)
    said = str(refused.report["findings"])
    assert "'Muscle Press' says psi, a unit of pressure_pa: are two columns exchanged?" in said
    assert "'Stroke' says in, a unit of position_m" in said
    assert "is this mm?" not in said
    assert import_with(source, text, "--accept-units").code == 0


@pytest.mark.parametrize(
    ("command", "shown"),
    [
        (5.0 + 4.0 * WAVE, "offset: -5.0}  # are these the driver's 0..10 V"),
        (8.0 * WAVE, "gain: 0.5}  # are these the driver's -10..10 V"),
    ],
)
@pytest.mark.parametrize("name", ["Valve [V]", "U_servo [V]"])
def test_the_first_map_that_is_shown_turns_the_volts_of_a_driver_into_the_command(
    tmp_path, name, command, shown
):
    columns = {"t_s": T_S, name: command, "Position [mm]": 1e3 * POSITION_M, "p [bar]": BAR}
    refused = Outcome(write_csv(tmp_path / "a.csv", columns))
    assert shown in refused.stderr
    text = refused.stderr.split("such as:\n")[1].replace("  ", "")
    done = import_with(tmp_path / "a.csv", text)
    np.testing.assert_allclose(done.signals.valve_v, 4.0 * WAVE, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "low", "high", "shown"),
    [
        ("I_valve_mA", 4.1, 19.8, "gain: 0.625, offset: -7.5"),
        ("Valve current [mA]", 0.1, 19.8, "gain: 0.5, offset: -5.0"),
        ("Ventil [%]", 2.0, 99.0, "gain: 0.1, offset: -5.0"),
        ("Ventil [%]", -90.0, 99.0, "gain: 0.05, offset: 0.0"),
    ],
)
def test_a_command_in_milliamperes_or_percent_gets_the_gain_of_its_span(
    tmp_path, name, low, high, shown
):
    command = np.linspace(low, high, len(T_S))
    refused = import_names(tmp_path / "a.csv", f"t,{name},x_mm", T_S, command, T_S)
    told = f"# valve: {{column: '{name}', unit: V, {shown}}}  # if it spans"
    assert told in everything(refused)
    unknown = import_names(tmp_path / "b.csv", f"t,{name},x_mm", T_S, 10.0 * command, T_S)
    assert "its unit is not known" in everything(unknown)


@pytest.mark.parametrize(
    "names",
    [
        "t,MPYE_setpoint_V,SDE_pressure_bar_abs,LVDT_pos_mm",
        "DAQ time [s],Sollwert [V],Hose pressure [bar abs],pos_mm_raw",
    ],
)
def test_a_column_in_doubt_is_taken_where_no_other_may_be_its_quantity_and_told(tmp_path, names):
    bar_abs, position_mm = GOOD["pressure_pa"] / 1e5, 1e3 * POSITION_M
    done = import_names(tmp_path / "a.csv", names, T_S, VALVE_V, bar_abs, position_mm)
    for quantity, values in GOOD.items():
        np.testing.assert_allclose(getattr(done.signals, quantity), values, atol=1e-9, rtol=1e-9)
    taken = [f["message"] for f in done.report["findings"] if f["kind"] == "map"]
    valve = names.split(",")[1]
    told = f"'{valve}' is taken as valve_v in V, as no other column may be it; if that is wrong"
    assert any(text.startswith(told) for text in taken)


@pytest.mark.parametrize(
    ("names", "asked"),
    [
        ("t_s,heater setpoint [V],x_mm,AI0 [V]", "'heater setpoint [V]' may be valve_v"),
        ("t_s,p_bar,Valve position [mm],valve_v", "'Valve position [mm]' may be position_m"),
        ("t_s,Hose pressure [bar],x_mm,Sonda [kPa]", "'Hose pressure [bar]' may be pressure_pa"),
    ],
)
def test_a_column_in_doubt_is_asked_for_where_another_has_its_unit_or_its_words(
    tmp_path, names, asked
):
    refused = import_names(tmp_path / "a.csv", names, T_S, T_S, 1e3 * POSITION_M, VALVE_V)
    assert f"{asked}, or something else" in refused.stderr


def test_a_time_without_its_unit_is_asked_for_where_its_rows_may_be_of_milliseconds(tmp_path):
    for every, is_told in ((0.05, False), (0.02, True)):
        times = every * np.arange(len(T_S))
        path = tmp_path / f"{every}.csv"
        done = import_names(path, "t,p_gauge_bar,x_mm", times, 2 + VALVE_V, 1e3 * POSITION_M)
        assert ("'t' is taken as t_s in s" in everything(done)) == is_told
        assert ("'t' states no unit for t_s" in everything(done)) != is_told


def test_an_angle_by_a_line_of_units_is_told_the_gain_that_makes_a_position_of_it(tmp_path):
    rows = [f"{k / 1000};{k % 7};{3 * (k % 5)}" for k in range(200)]
    text = "\n".join(["Zeit;Druck;Winkel Rolle", "s;bar;\N{DEGREE SIGN}", *rows])
    (tmp_path / "a.csv").write_text(text)
    done = Outcome(tmp_path / "a.csv")
    gain = "its gain is the radius of the pulley or lever in m times 0.0174533 (pi / 180)"
    said = f"an angle: with `unit: m`, {gain}"
    assert done.report["columns"][2]["left_out"] == said
    assert f"unit: m}}  # {said}" in done.report["map_text"]


def test_an_lvm_file_that_was_cut_off_says_so_and_loses_its_last_row(tmp_path, parsed_here):
    cut = [*ROWS[:250], ROWS[250][:-4]]
    source = write_lvm(tmp_path / "a.lvm", cut)
    done = import_with(
        source,
        LVM_MAP.format(pressure="Muscle Press, unit: psig", position="Stroke, unit: in"),
    )
    assert "its head states 400 samples, and 251 are there" in done.said["warning", "file"]
    assert len(done.signals.t_s) == 250


@pytest.mark.parametrize("ending", [".lvm", ".mat", ".tdms", ".xlsx", ".csv"])
def test_an_empty_file_is_called_empty_whatever_its_ending(tmp_path, ending):
    source = tmp_path / f"a{ending}"
    source.touch()
    assert Outcome(source).stderr.strip() == f"error: {source} is empty"


def test_volts_of_a_sensor_are_told_and_followed(tmp_path):
    columns = {"t_s": T_S, "valve_v": VALVE_V, "Druck [V]": 2.0 + np.sin(9.0 * T_S)}
    source = write_csv(tmp_path / "a.csv", columns)
    text = "time: {column: t_s}\nvalve: {column: valve_v}\npressure: {column: 'Druck [V]', unit: "
    bare = import_with(source, text + "bar, gauge: true}\n")
    assert "'Druck [V]' says V, and the map bar" in bare.said["warning", "map"]
    scaled = import_with(source, text + "bar, gauge: true, gain: 1.25}\n")
    assert not [said for said in scaled.said if said[1] == "map"]
