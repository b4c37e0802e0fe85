"""Records: where a run begins to move, and the sensors' noise before that."""

from __future__ import annotations

import numpy as np
import pytest
from support.made_records import PERIOD_S, measured

from pamctl.diagnose import Record
from pamctl.diagnose.sensor_noise import estimate_channel_noise
from pamctl.log.record_problems import find_sensor_step

RESTED = 800


def pulled(
    newtons_per_s: float, noise_n: float = 0.05, step_n: float = 0.0, keep: float = 0.0
) -> Record:
    """A force that rests for 0.8 s and then rises; its noise may be correlated."""
    t_s = np.arange(3000) * 1e-3
    random = np.random.default_rng(5)
    noise = random.normal(0.0, noise_n, len(t_s))
    for k in range(1, len(noise)):
        noise[k] = keep * noise[k - 1] + np.sqrt(1.0 - keep**2) * noise[k]
    force_n = newtons_per_s * np.maximum(t_s - RESTED * 1e-3, 0.0) + noise + 3.0
    if step_n:
        force_n = np.round(force_n / step_n) * step_n
    return Record("pulled", t_s, force_n=force_n)


@pytest.mark.parametrize("newtons_per_s", [2.0, 20.0, 130.0, 4000.0])
@pytest.mark.parametrize("keep", [0.0, 0.8])
def test_the_rest_of_a_force_ends_where_its_ramp_begins(newtons_per_s: float, keep: float) -> None:
    rest = pulled(newtons_per_s, keep=keep).rest_samples
    # The ramp needs this long to leave four deviations of the noise.
    assert abs(rest - RESTED) <= 3 + 1e3 * 4.0 * 0.05 / newtons_per_s


def test_the_noise_of_a_force_is_that_of_its_rest_and_not_of_its_ramp() -> None:
    noise = estimate_channel_noise([pulled(20.0)], "force_n")
    assert noise.total == pytest.approx(0.05, rel=0.05)


def test_the_steps_of_a_converter_do_not_end_the_rest() -> None:
    assert abs(pulled(50.0, noise_n=0.02, step_n=0.05).rest_samples - RESTED) <= 5


def test_a_constant_force_rests_throughout() -> None:
    assert pulled(0.0).rest_samples == 3000


def test_a_force_without_noise_leaves_its_rest_with_the_first_change() -> None:
    assert abs(pulled(10.0, noise_n=0.0).rest_samples - RESTED) <= 1


def test_noise_and_resolution_are_estimated_from_a_record() -> None:
    record = measured("fit", 5)
    assert find_sensor_step(record["position_m"]) == pytest.approx(3.175e-6)
    assert find_sensor_step(record["pressure_pa"]) == pytest.approx(47.5)
    assert estimate_channel_noise([record], "pressure_pa").deviation == pytest.approx(
        300.0, rel=0.05
    )


def test_correlated_noise_is_drawn_with_its_correlation() -> None:
    random = np.random.default_rng(3)
    coloured = np.convolve(random.normal(0.0, 300.0, 4010), np.ones(8) / np.sqrt(8.0))[8:4008]
    still = np.zeros(4000)
    record = Record(
        "rest", np.arange(4000) * PERIOD_S, valve_v=still - 5.0, pressure_pa=1.013e5 + coloured
    )
    drawn = estimate_channel_noise([record], "pressure_pa").draw(20_000, random)
    wanted, found = (np.corrcoef(v[1:], v[:-1])[0, 1] for v in (coloured, drawn))
    assert drawn.std() == pytest.approx(coloured.std(), rel=0.1)
    assert found == pytest.approx(wanted, abs=0.05)
