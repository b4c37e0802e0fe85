"""What an excitation can show at all: judged from the truths alone, before any diagnosis.

For every effect and size the rig is simulated with and without it, free of noise, and the
difference is cleared of what a recalibration would take away (least squares on its tangent) and
then of what a rival could imitate (its own difference, scaled freely). What is left, in units of
the sensors' floor, says whether the effect can be detected and told apart. The diagnosis is held
to nothing that this says cannot be done.

    PYTHONPATH=.:tests python -m hidden.examination.oracle      writes `oracle.json` again
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hidden.effects import MECHANICAL_BLOCK, ON_BOTH_BLOCKS, PRESSURE_BLOCK, SINGLES
from hidden.equations.truth import Truth
from hidden.excitations import PROGRAMS, Excitation
from hidden.rig import HiddenRig, hidden_rig, in_floors
from hidden.sensors import Sensors

Array = NDArray[np.float64]

SURE = 0.45
"""Above this share of the floor the residual's RMS is 10 % above the floor: it must be found."""
HOPELESS = 0.15
"""Below this share of the floor nobody is asked to find it."""

SIZES = (1, 3, 10)
ORACLE = Path(__file__).with_name("oracle.json")
ORACLE_PROGRAMS = ("standard", "short", "brief", "squares", "closed_loop")

EITHER_SIGN = {
    "valve_asymmetry", "valve_curve", "discharge_ratio", "cubic_stiffness", "external_load",
    "pressure_sensor_offset", "pressure_sensor_gain", "encoder_scale",
}  # fmt: skip
"""A rival may imitate with a negative size only where nature has one: no leak is negative."""

_TANGENTS = {
    "pressure": ("valve_m2_per_v", "supply_pa", "braid_m"),
    "mechanics": ("damping", "stiffness", "mu_k", "braid_m"),
}


@cache
def oracle_of(program: str) -> dict[str, dict[str, dict[str, float]]]:
    """Return what the truths alone say of a program's power, or nothing where it was not asked."""
    every: dict[str, dict[str, dict[str, dict[str, float]]]] = json.loads(ORACLE.read_text())
    return every.get(program, {})


def oracle(program: str, seed: int = 0) -> dict[str, dict[str, dict[str, float]]]:
    """Return name -> size -> {"alone": residual, rival: residual}, in shares of the floor."""
    train, held_out = PROGRAMS[program](seed)
    see = _Eye([*train, *held_out])
    differences = {(name, size): see.effect(name, size) for name in SINGLES for size in SIZES}
    found: dict[str, dict[str, dict[str, float]]] = {}
    for name in SINGLES:
        for size in SIZES:
            found.setdefault(name, {})[str(size)] = _judged(name, size, differences, see)
    return found


class _Eye:
    """Sees rigs without noise, and what recalibrating the paper's would change."""

    def __init__(self, runs: Sequence[Excitation]) -> None:
        self.runs = runs
        self.plain = self._seen(HiddenRig(Truth(), Sensors(perfect=True), 0, 20e-6))
        self.tangents = {
            block: np.stack([self._tangent(name) for name in names])
            for block, names in _TANGENTS.items()
        }

    def effect(self, name: str, size: int) -> Array:
        """Return the difference that an effect makes, shape (2, samples), in floors."""
        rig = hidden_rig({name: size}, seed=0, miscalibrated=False)
        # A homed encoder would have forgotten the load, wherever that is hidden.
        clear = replace(rig.sensors, perfect=True, encoder_homed=name != "external_load")
        return self._seen(replace(rig, sensors=clear, step_s=20e-6)) - self.plain

    def _tangent(self, name: str) -> Array:
        usual = getattr(Truth(), name)
        truth = Truth()._replace(**{name: usual * 1.001})
        return self._seen(HiddenRig(truth, Sensors(perfect=True), 0, 20e-6)) - self.plain

    def _seen(self, rig: HiddenRig) -> Array:
        return in_floors([rig.run(excitation).record for excitation in self.runs])


def _judged(
    name: str, size: int, differences: dict[tuple[str, int], Array], see: _Eye
) -> dict[str, float]:
    """Return the remaining share of one effect, alone and against each rival of its blocks."""
    blocks = _blocks(name)
    truth = differences[name, size]
    found = {"alone": round(_left(truth, None, True, blocks, see), 3)}
    for rival in SINGLES:
        shared = sorted({*blocks, *_blocks(rival)})
        if rival == name or not {*blocks} & {*_blocks(rival)}:
            continue
        left = (
            _left(truth, differences[rival, s], rival in EITHER_SIGN, shared, see) for s in SIZES
        )
        found[rival] = round(min(left), 3)
    return found


def _left(
    truth: Array, rival: Array | None, either_sign: bool, blocks: Sequence[str], see: _Eye
) -> float:
    """Return the RMS that no recalibration, and no multiple of the rival, can take away."""
    rows = [{"pressure": 0, "mechanics": 1}[block] for block in blocks]
    tangents = np.concatenate([see.tangents[block] for block in blocks])
    columns = tangents if rival is None else np.concatenate([tangents, rival[None]])
    matrix = columns[:, rows].reshape(len(columns), -1).T
    target = truth[rows].reshape(-1)
    scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
    solution = np.linalg.lstsq(matrix / scale, target, rcond=None)[0]
    if rival is not None and not either_sign and solution[-1] < 0.0:
        return _left(truth, None, True, blocks, see)
    left = (target - matrix / scale @ solution).reshape(len(rows), -1)
    return float(np.sqrt(np.mean(left**2, axis=1)).max())


def _blocks(name: str) -> tuple[str, ...]:
    if name in ON_BOTH_BLOCKS:
        return ("mechanics", "pressure")
    assert name in PRESSURE_BLOCK + MECHANICAL_BLOCK
    return ("pressure",) if name in PRESSURE_BLOCK else ("mechanics",)


def format_oracle(every: dict[str, dict[str, dict[str, dict[str, float]]]]) -> str:
    """Return the oracle as JSON, one line for each size of an effect."""
    programs = []
    for program, effects in every.items():
        rows = []
        for name, sizes in effects.items():
            lines = ",\n".join(f'   "{size}": {json.dumps(row)}' for size, row in sizes.items())
            rows.append(f'  "{name}": {{\n{lines}\n  }}')
        programs.append(f' "{program}": {{\n' + ",\n".join(rows) + "\n }")
    return "{\n" + ",\n".join(programs) + "\n}\n"


if __name__ == "__main__":
    ORACLE.write_text(format_oracle({program: oracle(program) for program in ORACLE_PROGRAMS}))
