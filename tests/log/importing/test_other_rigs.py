"""Files of rigs that pamctl does not describe, or describes by other names than the file's."""

from pathlib import Path

import numpy as np
import pytest
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
