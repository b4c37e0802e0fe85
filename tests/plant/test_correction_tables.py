"""Correction tables: errors that no effect explains, as part of the model."""

from __future__ import annotations

import math
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray
from support.made_records import all_but, pair

import pamctl.diagnose.extend
from pamctl.diagnose import Diagnosis, Record, Verdict, diagnose, summary, workflow
from pamctl.diagnose.extend import add_correction_tables
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.extended_plant_file import format_plant_file
from pamctl.diagnose.report.phrases import describe_correction
from pamctl.diagnose.terms.describe import Description
from pamctl.kernel.calls import machine
from pamctl.plant.correction_tables import CorrectionTable, interpolate_table
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import AirState, PlantState, ValveState, vented_state
from pamctl.plant.step import advance_plant, pressure_block_step
from pamctl.settings.resolve import SECTIONS, ConfigError, RawSettings, validate_settings

pytestmark = pytest.mark.long

SLOPING = CorrectionTable((0.0, 1.0, 3.0), (10.0, 20.0), (0.0, 10.0, 2.0, 12.0, 6.0, 16.0))
"""2 first + second - 10."""


def pull(force_n: Any = lambda x: 0.0) -> dict[str, Any]:
    lines = [0.0, 0.01, 0.02]
    rows = [[force_n(x)] * 2 for x in lines]
    return {"pull": {"displacement_m": lines, "load": [1e5, 4.4e5], "pull_n": rows}}


def flow(kg_per_s: float = 0.0) -> dict[str, Any]:
    rows = [[kg_per_s] * 2] * 3
    return {"flow": {"opening_v": [-5, 0, 5], "pressure_pa": [1e5, 4.4e5], "flow_kg_per_s": rows}}


def plant(**keys: Any) -> PlantSettings:
    return PlantSettings.model_validate(keys)


def driven(settings: PlantSettings, ticks: int = 400) -> list[PlantState]:
    p = plant_parameters(settings)
    states = [vented_state(p)]
    for tick in range(ticks):
        command_v = 3.0 * math.sin(0.02 * tick)
        states.append(advance_plant(p, states[-1], command_v, 1e-3, 0.5e-3))
    return states


def apart_m(one: list[PlantState], other: list[PlantState]) -> float:
    return max(abs(a.position_m - b.position_m) for a, b in zip(one, other, strict=True))


# --- in the plant ----------------------------------------------------------------------


def fill_lookup(
    table: CorrectionTable | None, first: float, second: float, found: NDArray[np.float64]
) -> None:
    found[0] = interpolate_table(table, first, second)


def look_up(table: CorrectionTable | None, first: float, second: float) -> float:
    """Look up in machine code."""
    found = np.empty(1)
    machine(fill_lookup)(table, first, second, found)
    return float(found[0])


def test_a_table_is_linear_between_its_lines_and_constant_beyond_them() -> None:
    for lookup in (interpolate_table, look_up):
        for first, second in ((0.0, 10.0), (0.5, 13.0), (1.0, 20.0), (2.9, 19.0), (3.0, 10.0)):
            assert lookup(SLOPING, first, second) == pytest.approx(2.0 * first + second - 10.0)
        assert lookup(SLOPING, 9.0, 99.0) == lookup(SLOPING, 3.0, 20.0)
        assert lookup(SLOPING, -9.0, -99.0) == lookup(SLOPING, 0.0, 10.0)
        assert lookup(None, 1.0, 2.0) == 0.0


def test_tables_of_zeros_leave_the_papers_model_to_the_bit() -> None:
    tabled, paper = driven(plant(correction={**pull(), **flow()})), driven(PlantSettings())
    assert [state[:3] for state in tabled] == [state[:3] for state in paper]


def test_a_pull_against_displacement_is_a_stiffer_spring() -> None:
    tabled = driven(plant(correction=pull(lambda x: -500.0 * x)))
    stiffer = driven(plant(parameters={"stiffness_n_per_m": 9680.0 + 500.0}))
    assert apart_m(tabled, stiffer) < 1e-9
    assert apart_m(tabled, driven(PlantSettings())) > 1e-4


def test_a_constant_flow_fills_a_closed_muscle_at_a_constant_rate() -> None:
    p = plant_parameters(plant(correction=flow(1e-5)))
    pressure_pa, valve, air = 2e5, ValveState(), AirState(p.tank_pressure_pa, 2e5)
    for _ in range(100):
        pressure_pa, valve, air = pressure_block_step(
            p, pressure_pa, valve, air, 0.0, 0.01, 0.01, 0.01, 0.0, 1e-3
        )
    length, braid = 0.19, 0.232
    room_m3 = length * (braid**2 - length**2) / (4.0 * math.pi * 1.94**2)
    risen_pa = 287.1 * 273.0 * 1e-5 * 0.1 / room_m3
    assert pressure_pa - 2e5 == pytest.approx(risen_pa, rel=1e-9)


def test_a_table_that_does_not_fit_together_is_refused_with_the_reason(tmp_path) -> None:
    ragged = pull()
    ragged["pull"]["pull_n"] = [[0.0, 0.0]] * 2
    falling = pull()
    falling["pull"]["load"] = [4.4e5, 1e5]
    for table, reason in ((ragged, "needs 3 rows of 2 values"), (falling, "load must increase")):
        with pytest.raises(ValueError, match=reason):
            plant(correction=table)
    path = tmp_path / "plant.yaml"
    path.write_text("correction: {pull: {displacement_m: [0, 0.02]}}\n")
    with pytest.raises(ConfigError, match=r"correction\.pull\.load"):
        validate_settings(SECTIONS["plant"], RawSettings.read(path), title="plant")


# --- by the diagnosis ------------------------------------------------------------------


def without_command(**hidden: float) -> tuple[list[Record], list[Record]]:
    """Pressure and position alone: one block, and half the work."""
    train, held = pair(**hidden)
    for part in (train, held):
        part[:] = [
            Record(r.name, r.t_s, pressure_pa=r.pressure_pa, position_m=r.position_m) for r in part
        ]
    return train, held


@cache
def nameless() -> Diagnosis:
    """A hardening spring, diagnosed by a catalogue that has no such thing, and without terms."""
    records = without_command(cubic_stiffness__n_per_m3=4e6)
    with patch.object(workflow, "describe_rest", lambda *given: Description(0, 0.0, ())):
        return diagnose(*records, PlantSettings(), without=all_but("creep"), correction=True)


def test_a_correction_table_is_added_on_request_and_shrinks_the_held_out_gap() -> None:
    found = nameless()
    assert found.verdict is Verdict.NONE_KNOWN
    assert not found.standings
    gap = build_diagnosis_document(found)["gap"]["position_m"]
    assert gap["corrected"] < 0.4 * gap["recalibrated"]
    table = build_diagnosis_document(found)["correction"]["table"]
    assert table["applied"]
    assert table["blocks"] == ["mechanics"]
    assert table["gap"]["position_m"]["after"] == gap["corrected"]
    assert "Unnamed correction added to the model" in summary(found)


def test_the_plant_file_with_the_table_is_read_again(tmp_path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(format_plant_file(nameless(), ["a.mcap"]))
    assert (
        validate_settings(SECTIONS["plant"], RawSettings.read(path), title="plant")
        == nameless().plant
    )
    assert "Unnamed correction" in path.read_text()


def test_a_table_that_makes_the_held_out_gap_larger_is_left_out(monkeypatch) -> None:
    found = nameless()
    before = found.plant.model_copy(update={"correction": None})
    worse = found.plant.parameters.model_copy(update={"stiffness_n_per_m": 20e3})
    bad = found.plant.model_copy(update={"parameters": worse})
    monkeypatch.setattr(pamctl.diagnose.extend, "fit_correction_table", lambda drives, plant: bad)
    assert found.base is not None
    kept = add_correction_tables(found.base, before, found.base.evidence)
    assert kept.plant == before
    assert kept.after == kept.before
    assert "left out of the model" in describe_correction(kept)


def test_no_table_is_added_without_a_request_or_without_a_remainder() -> None:
    records = without_command()
    found = diagnose(*records, PlantSettings(), without=all_but("creep"), correction=True)
    assert found.verdict is Verdict.NO_DISCREPANCY
    assert found.correction is None
    assert found.plant.correction is None
