"""Headers as laboratories and machine controllers write them: understood, or left as a question."""

from pathlib import Path

import pytest

from pamctl.log import LogError
from pamctl.log.importing.column_roles import HeaderMeaning, understand_header
from pamctl.log.importing.pipeline import import_log

UNDERSTOOD = {
    "Chamber pressure (bar g)": ("pressure_pa", "bar", True),
    "Kammerdruck [bar ü]": ("pressure_pa", "bar", True),
    "Überdruck / mbar": ("pressure_pa", "mbar", True),
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
    "zeit": ("t_s", "", None),
    "Ventil [V]": ("valve_v", "V", None),
    "Druck [bar rel]": ("pressure_pa", "bar", True),
    "Weg / mm": ("position_m", "mm", None),
    "Joint angle [deg]": ("position_m", "", None),
    "Gelenkwinkel [\N{DEGREE SIGN}]": ("position_m", "", None),
}
DOUBTFUL = ["F_z [N]", "Chamber A pressure [bar]", "pressure_cap_bar", "nActPos [mm]"]
NOT_MEASURED = [
    "Sollposition [mm]", "Position set point (mm)", "Supply pressure [bar]", "Versorgungsdruck_bar",
    "AI0 (V)", "Output voltage [V]", "y_mm", "Temperature (C)", "Position error [mm]",
]  # fmt: skip


@pytest.mark.parametrize(("header", "meaning"), UNDERSTOOD.items())
def test_a_header_says_quantity_unit_and_sense(header: str, meaning: tuple[object, ...]) -> None:
    found = understand_header(header)
    assert found is not None
    assert found.is_sure
    assert found[:3] == meaning


@pytest.mark.parametrize("header", DOUBTFUL)
def test_a_word_that_may_mean_another_sensor_is_a_question(header: str) -> None:
    assert isinstance(found := understand_header(header), HeaderMeaning)
    assert not found.is_sure


@pytest.mark.parametrize("header", NOT_MEASURED)
def test_another_thing_than_a_measured_quantity_is_not_read(header: str) -> None:
    assert understand_header(header) is None


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
    ],
)
def test_two_valves_chambers_or_joints_are_refused_without_a_map(
    tmp_path: Path, head: str, what: str
) -> None:
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
def test_raw_and_filtered_or_a_supply_that_rests_stay_a_question(
    tmp_path: Path, head: str, rests: bool
) -> None:
    with pytest.raises(LogError, match="--map FILE, such as"):
        import_log(write_table(tmp_path / "two.csv", head, rests), tmp_path / "two.mcap")


def test_an_angle_is_a_position_once_the_radius_is_said(tmp_path: Path) -> None:
    table = write_table(tmp_path / "joint.csv", "t_s,Joint angle [deg],Pressure [kPa abs]")
    with pytest.raises(LogError) as refused:
        import_log(table, tmp_path / "joint.mcap")
    asked = str(refused.value)
    assert "in m times 0.0174533" in asked
    assert "# position: {column: 'Joint angle [deg]', unit: m}" in asked


def test_what_is_left_out_says_why(tmp_path: Path) -> None:
    table = tmp_path / "axis.csv"
    write_table(table, "t_s,position [mm],Reference [mm]")
    done = import_log(table, tmp_path / "axis.mcap")
    assert "'reference' in its name" in done.columns[2].left_out


def test_a_mechanism_with_force_and_position_misses_nothing(tmp_path: Path) -> None:
    done = import_log(write_table(tmp_path / "axis.csv", "t_s,position_mm,force_n"), tmp_path / "a")
    assert not [f for f in done.findings if f.key == "columns"]


def test_a_column_that_nothing_names_is_listed_and_not_called_a_pressure(tmp_path: Path) -> None:
    with pytest.raises(LogError) as refused:
        import_log(write_table(tmp_path / "a.csv", "t_s,S1,Temperature [degC]"), tmp_path / "a")
    line = next(text for text in str(refused.value).splitlines() if "other columns" in text)
    assert "'S1', 'Temperature [degC]'; such as pressure: {column: NAME" in line
