"""Headers as laboratories and machine controllers write them: understood, or left as a question."""

from pathlib import Path

import pytest

from pamctl.cli.output import read_map
from pamctl.log import LogError
from pamctl.log.importing.column_map import ImportMap
from pamctl.log.importing.headers import Certainty, read_header
from pamctl.log.importing.measured_table import MapWanted
from pamctl.log.importing.pipeline import import_log

UNDERSTOOD = {
    "Chamber pressure (bar g)": ("pressure_pa", "bar", True),
    "Kammerdruck [bar ü]": ("pressure_pa", "bar", True),
    "Überdruck / mbar": ("pressure_pa", "mbar", True),
    "Druck [bar Überdruck]": ("pressure_pa", "bar", True),
    "P1 bar ueberdruck": ("pressure_pa", "bar", True),
    "Istdruck [kPa abs]": ("pressure_pa", "kPa", False),
    "p_rel (mbar)": ("pressure_pa", "mbar", True),
    "pm_kPa_abs": ("pressure_pa", "kPa", False),
    "PressureSensor.Value [bar]": ("pressure_pa", "bar", None),
    "Piston position [mm]": ("position_m", "mm", None),
    "Kolbenposition_mm": ("position_m", "mm", None),
    "ist_mm": ("position_m", "mm", None),
    "Laser (um)": ("position_m", "um", None),
    "actPos mm": ("position_m", "mm", None),
    "Carriage position (inch)": ("position_m", "in", None),
    "Fm_N": ("force_n", "N", None),
    "Load cell (kN)": ("force_n", "kN", None),
    "Kraftaufnehmer [N]": ("force_n", "N", None),
    "Ventilspannung [V]": ("valve_v", "V", None),
    "Proportional valve command (V)": ("valve_v", "V", None),
    "Stellgröße [V]": ("valve_v", "V", None),
    "AO0 (V)": ("valve_v", "V", None),
    "Zeit in ms": ("t_s", "ms", None),
    "time_s_since_start": ("t_s", "s", None),
    "sensor_pressure_bar_abs": ("pressure_pa", "bar", False),
    "zeit": ("t_s", "", None),
    "Ventil [V]": ("valve_v", "V", None),
    "Druck [bar rel]": ("pressure_pa", "bar", True),
    "Pression chambre absolue (mbar)": ("pressure_pa", "mbar", False),
    "Pression relative [bar]": ("pressure_pa", "bar", True),
    "Presión manométrica (bar)": ("pressure_pa", "bar", True),
    "Pressione muscolo [kPa assoluta]": ("pressure_pa", "kPa", False),
    "Pressão absoluta (bar)": ("pressure_pa", "bar", False),
    "ÜBERDRUCK [mbar]": ("pressure_pa", "mbar", True),
    "Mando válvula (V)": ("valve_v", "V", None),
    "Desplazamiento (in)": ("position_m", "in", None),
    "Bogenweg Gelenk [mm]": ("position_m", "mm", None),
    "Forza [N]": ("force_n", "N", None),
    "Weg / mm": ("position_m", "mm", None),
    "Joint angle [deg]": ("position_m", "", None),
    "Gelenkwinkel [\N{DEGREE SIGN}]": ("position_m", "", None),
}
DOUBTFUL = ["F_z [N]", "Chamber A pressure [bar]", "pressure_cap_bar", "nActPos [mm]",
            "SDE_pressure_bar_abs", "pos_mm_raw", "MPYE_setpoint_V", "Sollwert [V]"]  # fmt: skip
NOT_MEASURED = [
    "Sollposition [mm]", "Position set point (mm)", "Supply pressure [bar]", "Versorgungsdruck_bar",
    "AI0 (V)", "Output voltage [V]", "y_mm", "Temperature (C)", "Position error [mm]",
    "Druck_soll_V", "MPYE_setpoint_bar", "supply_pressure_bar_abs", "Speed setpoint [V]",
    "Reference voltage [V]",
]  # fmt: skip


@pytest.mark.parametrize(("header", "meaning"), UNDERSTOOD.items())
def test_a_header_says_quantity_unit_and_sense(header, meaning):
    found = read_header(header)
    assert found.certainty == Certainty.SURE
    assert found[:3] == meaning


@pytest.mark.parametrize("header", DOUBTFUL)
def test_a_word_that_may_mean_another_sensor_is_a_question(header):
    assert read_header(header).certainty == Certainty.DOUBT


@pytest.mark.parametrize("header", NOT_MEASURED)
def test_another_thing_than_a_measured_quantity_is_not_read(header):
    assert read_header(header).certainty < Certainty.DOUBT


def write_table(path: Path, head: str, rests: bool = False) -> Path:
    """Return a table of a time and two columns, of which the second may rest."""
    rows = [f"{k / 1000},{k % 7},{5.0 if rests else 3 + k % 5}" for k in range(200)]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("head", "what"),
    [
        ("t_s,u1 [V],u2 [V]", "the commands of several valves"),
        ("t_s,u1,u2", "the commands of several valves"),
        ("t_s,p1 [bar],p2 [bar]", "the pressures of several chambers"),
        ("t_s,Chamber A pressure [bar],Chamber B pressure [bar]", "several chambers"),
        ("t_s,x_1 [mm],x_2 [mm]", "the positions of several joints"),
        ("t_s,cap side pressure (bar abs),rod side pressure (bar abs)", "several chambers"),
        ("t_s,shoulder valve (V),elbow valve (V)", "the commands of several valves"),
    ],
)
def test_two_valves_chambers_or_joints_are_refused_without_a_map(tmp_path, head, what):
    with pytest.raises(LogError) as refused:
        import_log(write_table(tmp_path / "two.csv", head), tmp_path / "two.mcap")
    assert what in str(refused.value)
    assert "one valve, one chamber and one joint" in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("head", "rests"),
    [
        ("t_s,Pressure raw [bar],Pressure filtered [bar]", False),
        ("t_s,p1_raw [bar],p1_filt [bar]", False),
        ("t_s,P1 [bar],P2 [bar]", True),
    ],
)
def test_raw_and_filtered_or_a_supply_that_rests_stay_a_question(tmp_path, head, rests):
    with pytest.raises(LogError, match="--map FILE, such as"):
        import_log(write_table(tmp_path / "two.csv", head, rests), tmp_path / "two.mcap")


def write_map(path: Path, **columns: str) -> ImportMap:
    """Return a map with these columns beside the time."""
    lines = [f"{key}: {value}" for key, value in {"time": "{column: t_s}", **columns}.items()]
    path.write_text("\n".join(lines))
    return read_map(path) or ImportMap.model_validate({})


@pytest.mark.parametrize(
    ("second", "rests", "is_told"),
    [
        ("rod side pressure (bar abs)", False, True),
        ("p2 [bar]", False, True),
        ("cap side pressure filtered (bar abs)", False, False),
        ("supply pressure (bar abs)", False, False),
        ("rod side pressure (bar abs)", True, False),
        ("rod side temperature", False, False),
    ],
)
def test_a_map_that_leaves_another_chamber_out_is_told_so(tmp_path, second, rests, is_told):
    name = "cap side pressure (bar abs)"
    table = write_table(tmp_path / "two.csv", f"t_s,{name},{second}", rests)
    pressure = f"{{column: '{name}', unit: bar, gauge: false}}"
    import_map = write_map(tmp_path / "map.yaml", pressure=pressure)
    done = import_log(table, tmp_path / "two.mcap", import_map, accept_units=True)
    told = [f.message for f in done.findings if "pressures of several chambers" in f.message]
    assert bool(told) == is_told
    assert not told or f"'{second}' is not used, and moves apart from '{name}'" in told[0]


def test_a_map_that_says_another_unit_than_the_header_is_followed_and_told(tmp_path):
    head = "t_s,Presión manométrica (bar),Desplazamiento (in)"
    import_map = write_map(
        tmp_path / "map.yaml",
        pressure="{column: 2, unit: bar, gauge: false}",
        position="{column: 3, unit: mm}",
    )
    table = write_table(tmp_path / "a.csv", head)
    done = import_log(table, tmp_path / "a.mcap", import_map, accept_units=True)
    assert [f.message for f in done.findings if f.key == "map"] == [
        "'Presión manométrica (bar)' says gauge, and the map absolute: the map is followed",
        "'Desplazamiento (in)' says in, and the map mm: the map is followed",
    ]


def test_a_unit_that_cannot_be_is_the_one_that_the_header_says(tmp_path):
    table = write_table(tmp_path / "a.csv", "t_s,Pressure [kPa abs],Desplazamiento (in)")
    import_map = write_map(tmp_path / "map.yaml", position="{column: 3, unit: m}")
    refused = import_log(table, tmp_path / "a.mcap", import_map)
    (told,) = [f.message for f in refused.findings if f.key == "unit"]
    assert "is this in, as the column's name says? Then say `unit: in` in the map" in told
    assert "unit: in" in refused.map_text


def test_a_refusal_shows_a_map_for_every_quantity_with_the_names_of_the_columns(tmp_path):
    head = "t_s,Courant vanne,Sonda (bar),Corrente motore [mA],Regla (mm)"
    rows = [f"{k / 1000},{k % 7},{2 + k % 5},{k % 3},{k % 4}" for k in range(200)]
    (tmp_path / "a.csv").write_text("\n".join([head, *rows]))
    with pytest.raises(MapWanted) as refused:
        import_log(tmp_path / "a.csv", tmp_path / "a.mcap")
    lines = str(refused.value).splitlines()[1:]
    keys = [line.strip(" #").split("  #")[0] for line in lines]
    assert keys == [
        "time: {column: 't_s', unit: s}",
        "pressure: {column: 'Sonda (bar)', unit: bar, gauge: false}",
        "position: {column: 'Regla (mm)', unit: mm}",
        "valve: {column: 'Courant vanne', unit: V}",
        "other columns: 'Corrente motore [mA]'; such as",
        "force: {column: 'Corrente motore [mA]', unit: N, gain: 1.0}",
    ]
    keys.remove("other columns: 'Corrente motore [mA]'; such as")
    (tmp_path / "map.yaml").write_text("\n".join(keys))
    import_log(tmp_path / "a.csv", tmp_path / "a.mcap", read_map(tmp_path / "map.yaml"))


def test_an_import_without_a_drive_shows_the_map_that_would_name_it(tmp_path):
    table = write_table(tmp_path / "a.csv", "t_s,Corrente motore [mA],Posizione [mm]")
    done = import_log(table, tmp_path / "a.mcap")
    assert done.written
    assert "# force: {column: 'Corrente motore [mA]', unit: N, gain: 1.0}" in done.map_text
    (tmp_path / "map.yaml").write_text(done.map_text.replace("# force", "force"))
    import_map = read_map(tmp_path / "map.yaml")
    named = import_log(table, tmp_path / "b.mcap", import_map)
    assert (named.columns[1].read_as, named.map_text) == ("force_n, N", "")


def test_an_angle_is_a_position_once_the_radius_is_said(tmp_path):
    table = write_table(tmp_path / "joint.csv", "t_s,Joint angle [deg],Pressure [kPa abs]")
    with pytest.raises(LogError) as refused:
        import_log(table, tmp_path / "joint.mcap")
    asked = str(refused.value)
    assert "in m times 0.0174533" in asked
    assert "# position: {column: 'Joint angle [deg]', unit: m}" in asked
