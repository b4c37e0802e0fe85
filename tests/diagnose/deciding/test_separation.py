"""Two full strokes leave a question open; the chosen program answers it, as it was forecast."""

from __future__ import annotations

import numpy as np
import pytest
from support.made_records import COUNT_M, PERIOD_S, ask_only

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.drawn_programs import make_program, make_repeated_part, sample_commands
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings
from pamctl.plant.parameters import parameters_of

OFFSET_V = 0.1


def run(commands_v: np.ndarray, seed: int, experiment: object = None) -> Record:
    """Run a muscle whose valve's null is off, finely stepped."""
    random = np.random.default_rng(seed)
    driven = drive_coupled(
        parameters_of({"null_offset.offset_v": OFFSET_V}), commands_v, PERIOD_S, steps=16
    )
    return Record(
        f"run-{seed}",
        np.arange(len(commands_v)) * PERIOD_S,
        valve_v=commands_v,
        pressure_pa=driven.pressure_pa + random.normal(0.0, 300.0, len(commands_v)),
        position_m=np.floor(driven.position_m / COUNT_M + random.uniform()) * COUNT_M,
        settings={"experiment": experiment} if experiment else {},
    )


def test_full_strokes_leave_the_valve_open_and_the_chosen_program_names_its_null() -> None:
    strokes = run(sample_commands(make_program(make_repeated_part(5.0, 5.0)), PERIOD_S), 1)
    asked = ask_only("null_offset", "valve_asymmetry", "valve_deadband", "valve_curve")
    first = diagnose([strokes], [], PlantSettings(), without=asked)
    assert {"null_offset", "valve_asymmetry", "valve_deadband"} <= {*first.explanations}
    chosen = first.deciding
    assert chosen is not None
    assert chosen.promises
    again = run(sample_commands(chosen.program, PERIOD_S), 2, chosen.to_experiment())
    assert again["pressure_pa"].max() <= chosen.pressure_pa + 5e3
    second = diagnose([strokes, again], [], PlantSettings(), without=asked)
    assert second.explanations == ("null_offset",)
    (offset,) = (n for n in second.numbers if n.name == "null_offset.offset_v")
    assert offset.value == pytest.approx(OFFSET_V, rel=0.02)
    judged = {f.refuted: f for f in second.forecasts}
    assert {"valve_deadband", "valve_asymmetry"} <= {*judged}
    assert all(f.is_good for f in judged.values()), judged
