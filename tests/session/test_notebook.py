"""The notebook of the manual runs from its first cell to its last, and finds what is hidden."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import pamctl
from pamctl.manual import list_pages
from pamctl.settings.resolve import settings_to_data

SHORTER = {
    "GENERATIONS = 15": "GENERATIONS = 2",
    "(0.5, 1.0, 2.0)": "(1.0,)",
    '"amplitude_v": 3, "duration_s": 4': '"amplitude_v": 3, "duration_s": 2',
}
"""The same with less of each."""
NOTEBOOK = list_pages()[0].path.parent / "afternoon.ipynb"


@pytest.mark.long
def test_the_notebook_finds_the_dead_band_and_better_gains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    cells = [c for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"]
    assert not any(cell["outputs"] for cell in cells)
    seen: dict[str, Any] = {}
    done: set[str] = set()
    for number, cell in enumerate(cells, 1):
        source = "".join(cell["source"])
        for long, short in SHORTER.items():
            taken = source.replace(long, short)
            done.update([long] if taken != source else [])
            source = taken
        exec(compile(source, f"cell {number}", "exec"), seen)
    assert done == {*SHORTER}
    assert seen["diagnosis"].verdict == "named"
    effects = settings_to_data(seen["diagnosis"].plant)["effects"]
    assert effects["valve_deadband"]["fill_width_v"] == pytest.approx(0.25, abs=0.01)
    assert "valve deadband" in capsys.readouterr().out
    assert seen["after"].metrics.rms_error_m < seen["before"].metrics.rms_error_m
    assert len(seen["softer"].marks) == 1
    logs = sorted(tmp_path.glob("logs/*.mcap"))
    assert len(logs) == 7
    assert seen["rig"].state == "idle"
    assert all(pamctl.Run.open(log).ending.code == 0 for log in logs)
