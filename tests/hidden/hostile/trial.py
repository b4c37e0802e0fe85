"""The records of one case, and the plant file that its user typed."""

from __future__ import annotations

from hidden.hostile.file_of_lab import record_of
from hidden.hostile.programs import EXCITATIONS
from hidden.hostile.situations import HostileCase
from hidden.rig import HiddenRig, Record, hidden_rig
from pamctl.plant.model import MuscleParameters, PlantSettings

TRUTH_NAMES = {
    "mass_kg": "mass_kg",
    "damping_n_s_per_m": "damping",
    "stiffness_n_per_m": "stiffness",
    "rest_length_m": "rest_length_m",
    "braid_length_m": "braid_m",
    "braid_turns": "turns",
    "kinetic_friction_per_m": "mu_k",
    "braid_contact_area_m2": "contact_m2",
    "tank_pressure_pa": "supply_pa",
    "atmospheric_pressure_pa": "atmosphere_pa",
    "temperature_k": "wall_k",
    "valve_gain_m2_per_v": "valve_m2_per_v",
}
"""A number's name in the plant file, and in the truth."""


def rig_of(case: HostileCase) -> HiddenRig:
    """Build the rig: its numbers are a few per cent off the paper's, and its effects hidden."""
    return hidden_rig(case.effects, seed=case.seed)


def records_of(case: HostileCase) -> tuple[list[Record], list[Record]]:
    """Return the (training, held-out) records as the user's files hold them.

    They were recorded in turn, one to fit and one to judge: what changes from record to record
    changes in both.
    """
    rig = rig_of(case)
    train, held_out = EXCITATIONS[case.excitation](case.seed)
    order = [run for pair in zip(train, held_out, strict=True) for run in pair]
    last = max(len(order) - 1, 1)
    made = {run.name: record_of(rig, case.lab, run, k / last) for k, run in enumerate(order)}
    return [made[run.name] for run in train], [made[run.name] for run in held_out]


def start_plant(case: HostileCase) -> PlantSettings:
    """Return the plant file that the user typed."""
    numbers = MuscleParameters().model_dump()
    numbers |= {name: numbers[name] * factor for name, factor in case.lab.plant_factors.items()}
    return PlantSettings(parameters=MuscleParameters(**{**numbers, **case.lab.plant}))
