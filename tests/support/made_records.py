"""Short records of a muscle in which something is hidden, for the tests of the diagnosis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np

from pamctl.control.experiment import ProgramSettings, plan_experiment
from pamctl.diagnose import Diagnosis, Record
from pamctl.diagnose.evidence.weigh import list_pool, prepare_weigher
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings
from pamctl.plant.parameters import parameters_of

COUNT_M = 25.4e-3 / 8000.0
PERIOD_S = 1e-3
REST = {"wave": "hold", "valve_v": -5, "duration_s": 0.6}
PROGRAMS = {
    "fit": [
        REST,
        {"wave": "square", "frequency_hz": 1.25, "amplitude_v": 5, "cycles": 2},
        {"wave": "hold", "valve_v": 2, "duration_s": 0.12},
        {"wave": "staircase", "levels_v": [0.2, 0.5, 1.0], "hold_s": 0.1},
        {"wave": "multisine", "low_hz": 0.5, "high_hz": 40, "amplitude_v": 2.5, "duration_s": 3},
    ],
    "judge": [
        REST,
        {"wave": "square", "frequency_hz": 1, "amplitude_v": 4, "cycles": 1},
        {
            "wave": "multisine",
            "low_hz": 0.7,
            "high_hz": 50,
            "amplitude_v": 1.5,
            "bias_v": 0.1,
            "duration_s": 3,
        },
    ],
    "squares": [REST, {"wave": "square", "frequency_hz": 1, "amplitude_v": 5, "cycles": 4}],
}


def command_v(program: str) -> np.ndarray:
    """Sample a program's command at 1 kHz."""
    held = plan_experiment(ProgramSettings(kind="program", parts=PROGRAMS[program])).segments
    return np.concatenate([np.full(round(h.duration_s / PERIOD_S), h.valve_v) for h in held])


def measured(program: str, seed: int = 0, **hidden: float) -> Record:
    """Run a program on the paper's muscle with `hidden` numbers, `__` for a dot, finely stepped."""
    truth = parameters_of({name.replace("__", "."): value for name, value in hidden.items()})
    command = command_v(program)
    driven = drive_coupled(truth, command, PERIOD_S, steps=16)
    random = np.random.default_rng(seed)
    noisy = driven.pressure_pa + random.normal(0.0, 300.0, len(command))
    counts = np.floor(driven.position_m / COUNT_M + random.uniform())
    return Record(
        f"{program}-{seed}",
        np.arange(len(command)) * PERIOD_S,
        valve_v=command,
        pressure_pa=np.round(noisy / 47.5) * 47.5,
        position_m=counts * COUNT_M,
    )


def pair(**hidden: float) -> tuple[list[Record], list[Record]]:
    """Return the records for the fit and those to judge by."""
    return [measured("fit", 1, **hidden)], [measured("judge", 2, **hidden)]


def axis_plant(
    mass_kg: float, damping: float, stiffness: float = 0.0, **effects: dict[str, float]
) -> PlantSettings:
    """Return the plant file of an axis that a measured force moves."""
    parameters = {
        "mass_kg": mass_kg, "damping_n_s_per_m": damping, "stiffness_n_per_m": stiffness,
    }  # fmt: skip
    return PlantSettings.model_validate(
        {"actuator": "direct", "parameters": parameters, "effects": effects}
    )


def list_asked(records: Sequence[Record], plant: PlantSettings) -> frozenset[str]:
    """Return the name of all that is asked of these records."""
    weigher, _ = prepare_weigher(records, (), plant)
    return frozenset(h.name for h in list_pool(weigher.train, weigher.base, plant))


@cache
def list_asked_of_muscle() -> frozenset[str]:
    """Return the name of all that is asked of a muscle."""
    return list_asked([measured("fit")], PlantSettings())


def ask_only(*names: str, of: frozenset[str] | None = None) -> set[str]:
    """Return all that a test leaves out to save time; `(time)` asks every law of the time.

    `of` is all that is asked; of a muscle, if it is not told.
    """
    asked = list_asked_of_muscle() if of is None else of
    return {n for n in asked if not any(part in n for part in names)}


def names_of(found: Diagnosis) -> list[str]:
    """Return what a diagnosis says by name."""
    return [f.name for f in found.findings if f.level == "name"]


def numbers_of(found: Diagnosis) -> dict[str, float]:
    """Return the extended model's numbers by flat name."""
    assert found.evidence is not None
    return found.evidence.values


def to_records(parts: Iterable[Iterable[Any]]) -> tuple[list[Record], list[Record]]:
    """Return the records of a hidden rig as the diagnosis takes them."""
    train, held = ([Record(name=r.name, **r.columns()) for r in part] for part in parts)
    return train, held
