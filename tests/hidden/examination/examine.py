"""One case from its rig to the document that the diagnosis returns."""

from __future__ import annotations

from dataclasses import replace
from time import process_time
from typing import Any

import numpy as np

from hidden.examination.cases import Case, Damage
from hidden.excitations import PROGRAMS
from hidden.rig import PULLED, HiddenRig, Record, hidden_rig
from pamctl.diagnose import Record as Measured
from pamctl.diagnose import diagnose
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.plant.model import MuscleParameters, PlantSettings


def rig_of(case: Case) -> HiddenRig:
    """Build the rig that the case hides its effects in."""
    rig = hidden_rig(
        case.effects, seed=case.seed, miscalibrated=case.miscalibrated, actuator=case.actuator
    )
    missed = 3 if case.damage == "missed_ticks" else 0
    sensors = replace(rig.sensors, encoder_homed=case.encoder_homed, missed_ticks=missed)
    return replace(rig, sensors=sensors)


def records_of(case: Case) -> tuple[list[Record], list[Record]]:
    """Return the (training, held-out) records as the case's user has them."""
    rig = rig_of(case)
    if case.program == "own":
        from hidden.own_run import own_run  # it needs the tests' own helpers

        return [own_run(rig, "diagnosis", seed=1)], [own_run(rig, "diagnosis", seed=2)]
    return tuple(  # type: ignore[return-value]
        [_handed_in(rig.run(excitation).record, case) for excitation in runs]
        for runs in PROGRAMS[case.program](case.seed)
    )


def _handed_in(record: Record, case: Case) -> Record:
    lacking = record.without(*case.lacks)
    return damaged(lacking, case.damage) if case.damage not in ("", "missed_ticks") else lacking


def damaged(record: Record, damage: Damage) -> Record:
    """Return the record with the faults of a careless user."""
    pressure, position = record.pressure_pa, record.position_m
    if pressure is None or position is None:
        raise ValueError("only a whole record can be damaged")
    if damage == "clipped":
        return replace(record, pressure_pa=np.minimum(pressure, 290e3))
    if damage == "millimetres":
        return replace(record, position_m=position * 1e3)
    if damage == "stuck":
        return replace(record, position_m=np.full_like(position, position[0]))
    if damage == "shifted":
        return replace(record, pressure_pa=np.roll(pressure, 40))
    if damage == "gap":
        kept = np.ones(len(pressure), dtype=np.bool_)
        kept[len(kept) // 2 : len(kept) // 2 + 400] = False
        return replace(record, **{name: c[kept] for name, c in record.columns().items()})
    return record


def start_plant(case: Case) -> PlantSettings:
    """Return the model that the user starts from: the paper's, or the carriage's drawing."""
    if case.actuator == "muscle":
        return PlantSettings()
    drawing = MuscleParameters(
        mass_kg=PULLED.mass_kg, damping_n_s_per_m=PULLED.damping, stiffness_n_per_m=PULLED.stiffness
    )
    return PlantSettings(actuator="direct", parameters=drawing)


def examine(case: Case) -> dict[str, Any]:
    """Run the diagnosis on a case; return its document and the CPU seconds that it took."""
    train, held_out = records_of(case)
    handed = [[Measured(name=r.name, **r.columns()) for r in part] for part in (train, held_out)]
    began = process_time()
    diagnosis = diagnose(handed[0], handed[1], start_plant(case), without=case.removed)
    return {"document": build_diagnosis_document(diagnosis), "seconds": process_time() - began}
