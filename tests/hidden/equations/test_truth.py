"""The truths are fine enough, and what they hide can be seen, before the diagnosis is examined.

That they move as the paper says: `tests/plant/test_against_truth.py`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from hidden.effects import IN_TRUTH, ON_SENSORS
from hidden.equations.truth import Truth
from hidden.excitations import multisine
from hidden.rig import Record, hidden_rig
from hidden.sensors import ENCODER_STEP_M, Sensors

Array = NDArray[np.float64]
PAPER = Truth()
STEP_S = 20e-6


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("name", ["stribeck", "presliding", "line_restriction", "command_delay"])
def test_halving_the_step_moves_a_hard_truth_by_less_than_a_count(name: str) -> None:
    rig = hidden_rig({name: 3}, seed=4)
    excitation = multisine(1.2, 0.3, 60.0, 1.0, seed=1, bias_v=0.05)
    fine = replace(rig, step_s=2.5e-6, sensors=Sensors(perfect=True)).run(excitation)
    coarse = replace(rig, sensors=Sensors(perfect=True)).run(excitation)
    assert rms(coarse.true_position_m - fine.true_position_m) < ENCODER_STEP_M
    assert rms(coarse.true_pressure_pa - fine.true_pressure_pa) < 30.0


# --- what is hidden ----------------------------------------------------------------------------

PROBE = multisine(2.0, 0.5, 40.0, 1.0, seed=2)


@pytest.mark.parametrize("key", sorted({**IN_TRUTH, **ON_SENSORS}))
def test_an_effect_of_size_zero_hides_nothing(key: str) -> None:
    name, _, form = key.partition("/")
    none = hidden_rig({name: (0, form)}, seed=3, miscalibrated=False)
    assert none.truth == PAPER


@cache
def plain_probe() -> Record:
    plain = hidden_rig({}, seed=3, miscalibrated=False)
    return replace(plain, sensors=Sensors(perfect=True), step_s=STEP_S).run(PROBE).record


@pytest.mark.parametrize("key", sorted({**IN_TRUTH, **ON_SENSORS}))
def test_a_larger_effect_is_more_visible(key: str) -> None:
    name, _, form = key.partition("/")
    base, apart = plain_probe(), []
    for size in (0.1, 10):
        rig = hidden_rig({name: (size, form)}, seed=3, miscalibrated=False)
        clear = replace(rig.sensors, perfect=True)
        seen = replace(rig, sensors=clear, step_s=STEP_S).run(PROBE).record
        assert seen.pressure_pa is not None
        assert seen.position_m is not None
        apart.append(
            rms(seen.pressure_pa - base.pressure_pa) / 300.0
            + rms(seen.position_m - base.position_m) / ENCODER_STEP_M
        )
    assert apart[0] < apart[1]
