"""Files of rigs that pamctl does not describe, or describes by other names than the file's."""

from pathlib import Path

import numpy as np
import pytest
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat
from test_log_import import Outcome

T_S = 0.004 * np.arange(1500)
BORE_MM2, RING_MM2 = 1963.0, 982.0
"""Areas of a piston, and of its side with the rod."""


def write_cylinder(path: Path, names: str, low_bar: float) -> Path:
    """Write what drives a double-acting cylinder: both of its pressures, which balance its load."""
    command_v = 4.0 * np.sin(2.0 * np.pi * 0.7 * T_S)
    cap_bar = low_bar * (2.0 + np.tanh(command_v) + 0.01 * np.sin(40.0 * T_S))
    rod_bar = cap_bar * BORE_MM2 / RING_MM2 + 0.02 * low_bar * np.cos(5.0 * T_S)
    place_mm = 150.0 + 60.0 * np.sin(2.0 * np.pi * 0.7 * T_S - 1.0)
    rows = np.column_stack([T_S, command_v, cap_bar, rod_bar, place_mm])
    lines = [names, *(";".join(f"{cell:.3f}" for cell in row) for row in rows)]
    path.write_text("\n".join(lines).replace(".", ",") + "\n", "cp1252")
    return path


@pytest.mark.parametrize("low_bar", [1.0, 12.0], ids=["air", "oil"])
@pytest.mark.parametrize(
    "names",
    [
        "Time [s];Valve command [V];Cap side pressure [bar];Rod side pressure [bar];Position [mm]",
        "Time [s];Valve command [V];p_A [bar];p_B [bar];Position [mm]",
        "Zeit [s];Ventilspannung [V];Druck kolbenseitig [bar];Druck stangenseitig [bar];Weg [mm]",
        "Temps [s];Commande [V];Pression côté fond [bar];Pression côté tige [bar];Course [mm]",
        "Temps [s];Commande [V];Pression chambre A [bar];Pression chambre B [bar];Course [mm]",
    ],
)
def test_the_two_sides_of_a_cylinder_are_refused_as_two_chambers(tmp_path, names, low_bar):
    refused = Outcome(write_cylinder(tmp_path / "a.csv", names, low_bar))
    assert refused.code == 65
    cap, rod = names.split(";")[2:4]
    assert f"{cap!r} and {rod!r} look like the pressures of several chambers" in refused.stderr
    assert "--map FILE, such as" not in refused.stderr


def test_two_sensors_of_one_pressure_in_two_units_stay_a_question(tmp_path):
    head = "Time [s];Valve command [V];hose pressure [bar];line pressure [kPa];Position [mm]"
    source = write_cylinder(tmp_path / "a.csv", head, 1.0)
    lines = [line.split(";") for line in source.read_text().replace(",", ".").splitlines()]
    for cells in lines[1:]:
        cells[3] = f"{100.0 * float(cells[2]) + 1.5:.3f}"
    source.write_text("\n".join(map(";".join, lines)))
    assert "--map FILE, such as" in Outcome(source).stderr


def test_french_words_of_a_cylinder_and_its_valve_need_no_map(tmp_path):
    names = "Temps [s];Tension distributeur [V];Pression absolue [bar];repos;Course tige [mm]"
    done = Outcome(write_cylinder(tmp_path / "a.csv", names, 1.0))
    read = [column["read_as"].split(",")[0] for column in done.report["columns"]]
    assert read == ["t_s", "valve_v", "pressure_pa", "", "position_m"]
    assert done.signals.position_m[0] == pytest.approx(0.15 - 0.06 * np.sin(1.0), abs=1e-6)


# Units beside the columns, and what has none that a rig is described in.

AXIS = {
    "time": (T_S, "s"),
    "enc_cnt": (np.rint(6e4 * np.sin(5.0 * T_S)), "counts"),
    "i_cmd": (0.8 * np.sin(9.0 * T_S), "A"),
    "status": (np.full(len(T_S), 7, np.uint8), ""),
}
"""A motor's axis: a current, and an encoder of 1 um."""


def write_axis(path: Path, key: str = "unit") -> Path:
    """Write the axis, units as HDF5 attributes or, in a MAT file, as fields of structs."""
    if path.suffix == ".mat":
        channels = {name: {"data": values, key: unit} for name, (values, unit) in AXIS.items()}
        savemat(path, {"meas": channels})
        return path
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, (values, unit) in AXIS.items():
            file.create_dataset(f"meas/{name}", data=values).attrs[key] = unit
    return path


def write_map(path: Path, *lines: str) -> list[str]:
    path.write_text("\n".join(lines))
    return ["--map", str(path)]


@pytest.mark.parametrize(("name", "key"), [("a.h5", "unit"), ("a.h5", "Units"), ("a.mat", "units")])
def test_units_beside_an_array_are_read_and_a_current_is_asked_for_its_force(tmp_path, name, key):
    refused = Outcome(write_axis(tmp_path / name, key))
    end = ".data" if name == "a.mat" else ""
    time, enc, current, status = (f"meas.{field}{end}" for field in AXIS)
    lines = [line.strip() for line in refused.shown_map.splitlines()]
    assert lines[0] == f"time: {{column: '{time}', unit: s}}"
    assert lines[1].startswith(f"# position: {{column: '{enc}', unit: m}}")
    assert lines[1].endswith("or gain (m per counts) and offset")
    force = f"# force: {{column: '{current}', unit: N}}  # a motor's current: add gain, its force"
    assert lines[2].startswith(force)
    assert [line for line in lines if status in line] == [f"# other columns: '{status}'"]


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ("valve: {column: 'meas.i_cmd', unit: V}", "A: is it force_n? If not, add `gain`, in V"),
        ("force: {column: 'meas.i_cmd', unit: N}", "A: add `gain`, in N per A"),
        ("position: {column: 'meas.enc_cnt', unit: mm}", "counts: add `gain`, in mm per counts"),
    ],
)
def test_a_current_or_counts_without_a_gain_are_asked_for_it(tmp_path, part, said):
    parts = {"position": "position: {column: 'meas.enc_cnt', unit: mm, gain: 0.001}"}
    parts[part.split(":")[0]] = part
    time = "time: {column: 'meas.time', unit: s}"
    options = write_map(tmp_path / "map.yaml", time, *parts.values())
    refused = Outcome(write_axis(tmp_path / "a.h5"), *options)
    assert refused.code != 0
    assert said in refused.said["error", "unit"]


def test_an_import_does_not_advise_what_its_map_says_already(tmp_path):
    head = "Time [s];Valve command [V];Pressure [bar gauge];rest [V];Position [mm]"
    source = write_cylinder(tmp_path / "a.csv", head, -1.0)
    refused = Outcome(source)
    assert "no rig has that: is it another column, or does it need another gain?" in str(
        refused.said
    )
    assert "gauge: true` in the map" not in refused.stderr


def test_a_cut_tdms_file_says_so_whatever_the_map_and_gives_the_rows_that_are_whole(tmp_path):
    source, whole = tmp_path / "a.tdms", tmp_path / "whole.tdms"
    waveform = {"wf_increment": 0.004, "wf_start_offset": 0.0}
    names = {"Valve": "V", "Pressure": "kPa", "Angle": "deg"}
    channels = [
        ChannelObject("AI", name, 300.0 + np.sin(T_S), {**waveform, "unit_string": unit})
        for name, unit in names.items()
    ]
    with TdmsWriter(str(whole)) as writer:
        writer.write_segment(channels)
    source.write_bytes(whole.read_bytes()[:-9000])
    parts = ["pressure: {column: Pressure, unit: kPa, gauge: false}",
             "position: {column: Angle, unit: m, gain: 4e-4}"]  # fmt: skip
    options = write_map(tmp_path / "map.yaml", "time: {column: time_s}", *parts)
    assert "; the file is damaged: " in Outcome(source, *options).stderr
    time = "time: {column: time of Valve}"
    refused = Outcome(source, *write_map(tmp_path / "map.yaml", time, *parts))
    (way_on,) = [text.strip(" `") for text in refused.stderr.split(";") if "lines:" in text]
    line = way_on.partition("`")[0]
    done = Outcome(source, *write_map(tmp_path / "map.yaml", time, *parts, line))
    assert done.code == 0, done.stderr
    assert len(done.signals.t_s) == int(line.strip("}").rpartition(" ")[2])
