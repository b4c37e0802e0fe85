"""What a fault leaves after a recalibration: judged from the truths alone, before any diagnosis.

A file is made without noise. A rig with the plant file's numbers is driven by the file's own
command, and its six fitted numbers are moved until pressure and displacement are as near to the
file as they come (Gauss-Newton). What is left, in shares of the floor, says whether anything is
there to be named: nobody is asked to name what a recalibration takes away.

    PYTHONPATH=.:tests python -m hidden.hostile.visible      writes `visible.json` again
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hidden.equations.truth import Truth
from hidden.examination.oracle import HOPELESS
from hidden.excitations import Excitation
from hidden.hostile.file_of_lab import record_of
from hidden.hostile.lab import TRUTH_NAMES
from hidden.hostile.programs import EXCITATIONS
from hidden.hostile.situations import HostileCase, all_cases
from hidden.rig import HiddenRig, Record, hidden_rig, in_floors
from hidden.sensors import Sensors

Array = NDArray[np.float64]

STORED = Path(__file__).with_name("visible.json")

FITTED = ("damping", "stiffness", "mu_k", "valve_m2_per_v", "supply_pa", "braid_m")
SECONDS = 4.0
STEP_S = 50e-6
ROUNDS = 3


@cache
def stored_shares() -> dict[str, float]:
    """Return what is left by a case's name, in shares of the floor."""
    shares: dict[str, float] = json.loads(STORED.read_text())
    return shares


def is_hopeless(case: HostileCase) -> bool:
    """Tell whether a recalibration leaves nothing that anybody could name."""
    return stored_shares().get(case.id, np.inf) < HOPELESS


def format_shares(cases: Iterable[HostileCase]) -> str:
    """Return what is left of the small faults that must be named, as `visible.json` holds it."""
    asked = (c for c in cases if c.size == "small" and not c.answer.silent and not c.answer.noise)
    lines = [f' "{case.id}": {measure_share(case):.3f}' for case in asked]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def measure_share(case: HostileCase) -> float:
    """Return the RMS that no recalibration takes away, in floors: of the worse of the channels."""
    rig = hidden_rig(case.effects, seed=7, miscalibrated=False)
    rig = replace(rig, sensors=replace(rig.sensors, perfect=True), step_s=STEP_S)
    train, held_out = EXCITATIONS[case.excitation](7)
    files = [
        record_of(rig, case.lab, _shorten(run), order)
        for run, order in ((train[0], 0.0), (held_out[-1], 1.0))
    ]
    typed = case.start_plant().parameters
    model = Truth(**{mine: getattr(typed, name) for name, mine in TRUTH_NAMES.items()})
    seen = in_floors(files)
    best = np.inf
    for _ in range(ROUNDS):
        error = seen - _predict(model, files)
        best = min(best, float(np.sqrt(np.mean(error**2, axis=1)).max()))
        tangents = [
            (_predict(_moved(model, name, 1e-3), files) - (seen - error)).ravel() / 1e-3
            for name in FITTED
        ]
        steps = np.linalg.lstsq(np.stack(tangents, axis=1), error.ravel(), rcond=None)[0]
        for name, step in zip(FITTED, steps, strict=True):
            limit = 0.01 if name == "braid_m" else 0.2
            model = _moved(model, name, float(np.clip(step, -limit, limit)))
    return best


def _shorten(run: Excitation) -> Excitation:
    n = round(SECONDS * 1e3)
    cut = {k: v[:n] for k in ("volts", "wanted_m") if (v := getattr(run, k)) is not None}
    return replace(run, **cut)


def _moved(model: Truth, name: str, share: float) -> Truth:
    value = getattr(model, name) * (1.0 + share)
    if name == "braid_m":  # a muscle that contracts when it is filled
        value = min(max(value, model.rest_length_m * 1.02), model.rest_length_m * 1.7)
    return model._replace(**{name: value})


def _predict(model: Truth, files: list[Record]) -> Array:
    """Return what a rig of these numbers shows under the files' commands."""
    perfect = HiddenRig(model, Sensors(perfect=True), 0, STEP_S)
    runs = [
        perfect.run(Excitation(file.name, file.valve_v, rest_v=float(file.valve_v[0]))).record
        for file in files
        if file.valve_v is not None
    ]
    return in_floors(runs)


if __name__ == "__main__":
    STORED.write_text(format_shares(all_cases()))
