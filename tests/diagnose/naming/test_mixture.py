"""Two models that are not nested: the best mixture of both says which one is true."""

from __future__ import annotations

import numpy as np
import pytest

from pamctl.diagnose.judging.mixture import (
    Mixture,
    is_first_alone,
    is_second_alone,
    mix_models,
)
from pamctl.diagnose.measured.record import Array

PERIOD_S = 1e-3
TIME_S = np.arange(20_000) * PERIOD_S


def _noise(seed: int) -> Array:
    return np.random.default_rng(seed).standard_normal(len(TIME_S))


def _slow(seed: int) -> Array:
    """Return a slow signal of RMS 1 that no noise resembles."""
    phase, rate_hz = np.random.default_rng(seed).uniform(0.5, 3.0, 2)
    return np.sqrt(2.0) * np.sin(2.0 * np.pi * rate_hz * TIME_S + phase)


@pytest.mark.parametrize("size", [0.2, 0.4])
def test_a_rival_a_fifth_of_the_noise_away_is_refuted_beside_the_truth(size: float) -> None:
    found = [mix_models(_noise(s), _noise(s) + size * _slow(s), PERIOD_S) for s in range(20)]
    assert all(m.is_first and not m.is_second for m in found)
    assert [m.distance for m in found] == pytest.approx([size**2] * 20, rel=0.01)


def test_the_order_of_both_models_does_not_matter() -> None:
    one, other = _noise(1), _noise(1) + 0.3 * _slow(1)
    forward, back = mix_models(one, other, PERIOD_S), mix_models(other, one, PERIOD_S)
    assert (back.low, back.high) == pytest.approx((1.0 - forward.high, 1.0 - forward.low))
    assert forward.is_first
    assert back.is_second


def test_models_that_show_the_same_are_not_told_apart() -> None:
    found = [mix_models(_noise(s), _noise(s) + 0.1 * _slow(s), PERIOD_S) for s in range(20)]
    assert not any(m.is_first or m.is_second for m in found)


def test_a_truth_half_way_between_two_models_refutes_neither() -> None:
    for seed in range(20):
        half = 0.25 * _slow(seed)
        found = mix_models(_noise(seed) + half, _noise(seed) - half, PERIOD_S)
        assert not any((found.is_first, found.is_second))
        assert found.low < 0.5 < found.high


def test_a_difference_that_one_moment_makes_is_not_enough() -> None:
    step = np.where(TIME_S < 0.5, 2.0, 0.0)
    there = np.where(TIME_S < 0.5, 1.0, 0.0) + _noise(3)  # the truth is half of it
    found = mix_models(there, there - step, PERIOD_S)
    assert not any((found.is_first, found.is_second))


def test_one_block_may_refute_a_model_but_not_where_another_block_asks_for_it() -> None:
    first, second = Mixture(-0.1, 0.1, 0.5), Mixture(0.9, 1.1, 0.5)
    unsure = Mixture(-2.0, 3.0, 0.5)
    assert is_first_alone([first, unsure])
    assert is_second_alone([unsure, second])
    assert not is_first_alone([first, second])
    assert not is_second_alone([first, second])
