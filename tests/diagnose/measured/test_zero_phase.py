"""The filters without delay, beside scipy's, which are run forwards and backwards in time."""

from __future__ import annotations

import numpy as np
import pytest
from pamctl.diagnose.judging.segments import differentiate
from scipy.signal import butter, savgol_filter, sosfiltfilt, sosfreqz
from scipy.signal.windows import blackmanharris
from scipy.stats import false_discovery_control

from pamctl.diagnose.locate import flag_discoveries
from pamctl.diagnose.measured.noise.spectrum import _shape_window
from pamctl.diagnose.measured.zero_phase import pass_band, respond_band_pass, smooth_below

RANDOM = np.random.default_rng(4)
WALK = np.cumsum(RANDOM.normal(size=9001))


@pytest.mark.parametrize("cutoff", [0.002, 0.06, 0.4])
def test_a_low_pass_equals_scipys_away_from_the_ends(cutoff: float) -> None:
    smooth, mirrored = smooth_below(WALK, cutoff), round(1.0 / cutoff)
    other = sosfiltfilt(
        butter(2, 2.0 * cutoff, output="sos"), WALK, padtype="even", padlen=mirrored
    )
    apart = np.abs(smooth - other) / WALK.std()
    inside = 4 * mirrored + 100
    assert np.max(apart[inside:-inside]) < 1e-6
    assert np.max(apart) < 0.02


def test_a_constant_and_a_short_record_stay_as_they_are() -> None:
    np.testing.assert_allclose(smooth_below(np.full(500, 7.0), 0.06), 7.0, rtol=1e-12)
    assert smooth_below(np.array([1.0, 2.0, 4.0]), 0.06).shape == (3,)


def test_a_band_pass_equals_scipys_away_from_the_ends() -> None:
    low, high = 0.035, 0.07
    sections = butter(2, [low, high], "bandpass", fs=1.0, output="sos")
    apart = pass_band(WALK, low, high) - sosfiltfilt(sections, WALK)
    assert np.max(np.abs(apart[1000:-1000])) < 1e-6 * WALK.std()
    share = np.array([0.03, 0.05, 0.2])
    gains = np.abs(sosfreqz(sections, 2.0 * np.pi * share)[1]) ** 2
    np.testing.assert_allclose(respond_band_pass(share, low, high), gains, rtol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_equal_scipys_at_the_ends_too(order: int) -> None:
    slope = differentiate(WALK, 1e-3, 0.031, order)
    expected = savgol_filter(WALK, 31, 2, deriv=order, delta=1e-3)
    np.testing.assert_allclose(slope, expected, atol=1e-9 * np.abs(expected).max())


def test_a_window_and_discoveries_equal_scipys() -> None:
    np.testing.assert_allclose(_shape_window(64), blackmanharris(64, sym=False), atol=1e-12)
    for share in (1e-3, 0.05, 0.3, 1.0):
        p = RANDOM.uniform(size=40) * share
        expected = false_discovery_control(p) <= 0.05
        np.testing.assert_array_equal(flag_discoveries(p, 0.05), expected)
    assert flag_discoveries([]).shape == (0,)
