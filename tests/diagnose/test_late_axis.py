"""An axis whose position is logged late, with friction, judged in windows."""

from __future__ import annotations

import numpy as np
import pytest
from diagnose.test_cogging import positioned
from support.made_records import ask_only, list_asked, numbers_of

from pamctl.diagnose import Record, diagnose
from pamctl.plant.model import PlantSettings

LATE = 3
"""Samples of 1 ms."""


def log_late(record: Record) -> Record:
    """Return a record whose position stands so many samples below the force that it had."""
    assert record.force_n is not None
    assert record.position_m is not None
    return Record(
        record.name,
        record.t_s[:-LATE],
        force_n=record.force_n[LATE:],
        position_m=record.position_m[:-LATE],
    )


def test_a_late_position_is_found_where_each_window_begins_with_the_measured_state() -> None:
    parameters = {"mass_kg": 3.0, "damping_n_s_per_m": 22.0, "stiffness_n_per_m": 0.0}
    plant = PlantSettings.model_validate({"actuator": "direct", "parameters": parameters})
    late = [log_late(positioned(seed, cogging_n=0.0)) for seed in (1, 2)]
    asked = "coulomb_friction", "presliding", "late", "mass", "creep"
    found = diagnose(late, [], plant, without=ask_only(*asked, of=list_asked(late, plant)))
    numbers = numbers_of(found)
    assert {"coulomb_friction", "position_late"} <= {f.name for f in found.findings}
    assert numbers["~late.position_m"] == pytest.approx(LATE * 1e-3, abs=2e-4)
    assert np.isclose(numbers["mass_kg"], 3.1, rtol=0.02)
