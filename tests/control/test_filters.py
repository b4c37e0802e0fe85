"""The filters agree with SciPy, and the derivatives with known motions."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from pamctl.control.filters import (
    UNPRIMED,
    FilterGains,
    LowPass,
    estimate,
    low_pass,
    prime_filter,
    warp_cutoff,
)
from pamctl.signals import Estimate, Measurement, Phase, Reference

DT_S = 1e-3
NAN = math.nan


def filtered(
    cutoff_hz: float, values: Sequence[float], dt_s: float | Sequence[float] = DT_S, start=0.0
) -> np.ndarray:
    state: LowPass = prime_filter(start)
    levels = []
    for value, dt in zip(values, np.broadcast_to(dt_s, len(values)).tolist(), strict=True):
        level, state = low_pass(state, warp_cutoff(cutoff_hz, dt), value)
        levels.append(level)
    return np.array(levels)


@pytest.mark.parametrize("cutoff_hz", [0.5, 10.0, 185.0, 300.0, 440.0])
def test_the_filter_is_scipys_third_order_butterworth(cutoff_hz):
    values = np.random.default_rng(1).normal(size=5000)
    expected = signal.sosfilt(signal.butter(3, cutoff_hz, fs=1 / DT_S, output="sos"), values)
    # SciPy's own coefficients are good to no more at 0.5 Hz, where its poles lie next to 1.
    np.testing.assert_allclose(filtered(cutoff_hz, values.tolist()), expected, rtol=0, atol=4e-12)


cutoffs = st.sampled_from([0.5, 10.0, 185.0, 300.0, 1000.0])
tick_lengths = st.lists(st.floats(1e-4, 50e-3), min_size=1, max_size=60)


@given(cutoffs, tick_lengths, st.floats(-100, 100))
def test_no_change_of_dt_disturbs_a_constant(cutoff_hz, dts, level):
    levels = filtered(cutoff_hz, [level] * len(dts), dts, start=level)
    np.testing.assert_allclose(levels, level, rtol=0, atol=1e-12 * max(1.0, abs(level)))


@given(cutoffs.filter(lambda hz: hz > 1), tick_lengths, st.integers(0, 2**32 - 1))
def test_the_filter_stays_stable_for_any_dt_and_recovers(cutoff_hz, dts, seed):
    """A fast filter may overshoot after a gap; the overshoot is bounded and decays fast."""
    values = np.random.default_rng(seed).uniform(-1, 1, len(dts)).tolist()
    levels = filtered(cutoff_hz, values + [0.5] * 600, [*dts, *[DT_S] * 600])
    assert np.abs(levels).max() <= 8.0
    assert levels[-1] == pytest.approx(0.5, abs=1e-3)


def reference(position_m: float) -> Reference:
    return Reference(Phase.TRACK, position_m, 0.0, 0.0, 0.0, NAN)


OPEN_LOOP = Reference(Phase.OPEN_LOOP, NAN, NAN, NAN, NAN, 1.0)


def estimates(
    gains: FilterGains,
    positions: Sequence[float],
    dt_s: float | Sequence[float] = DT_S,
    references: Sequence[Reference] | None = None,
) -> list[Estimate]:
    state, found = UNPRIMED, []
    dts = np.broadcast_to(dt_s, len(positions)).tolist()
    for n, (position, dt) in enumerate(zip(positions, dts, strict=True)):
        asked = references[n] if references else reference(0.0)
        measurement = Measurement(float(position), 2e5)
        estimated, state = estimate(gains, state, measurement, asked, dt)
        found.append(estimated)
    return found


@pytest.mark.parametrize(("lpf2_hz", "seconds"), [(0.5, 20.0), (20.0, 2.0), (185.0, 1.0)])
def test_the_derivatives_of_a_parabola_are_correct_and_delayed(lpf2_hz, seconds):
    """A trapezoidal Butterworth of third order delays a ramp by dt / tan(pi f dt)."""
    times_s = np.arange(0, seconds, DT_S)
    last = estimates(FilterGains(300.0, lpf2_hz), 0.5 * 0.3 * times_s**2)[-1]
    delay_s = DT_S / 2 + sum(DT_S / math.tan(math.pi * hz * DT_S) for hz in (300.0, lpf2_hz))
    assert last.error_acceleration_m_per_s2 == pytest.approx(0.3, rel=1e-6)
    assert last.error_rate_m_per_s == pytest.approx(0.3 * (times_s[-1] - delay_s), rel=1e-6)


def test_the_error_is_the_filtered_position_minus_the_reference():
    times_s = np.arange(0, 0.2, DT_S)
    positions = np.random.default_rng(4).normal(0, 1e-3, len(times_s))
    asked = [reference(0.01 + 0.05 * t) for t in times_s]
    found = estimates(FilterGains(300.0, 0.5), positions, DT_S, asked)
    sos = signal.butter(3, 300.0, fs=1 / DT_S, output="sos")
    smooth = positions[0] + signal.sosfilt(sos, positions - positions[0])
    np.testing.assert_allclose([e.position_filtered_m for e in found], smooth, atol=1e-15)
    errors = smooth - [r.reference_m for r in asked]
    np.testing.assert_allclose([e.error_m for e in found], errors, atol=1e-15)


def test_the_derivatives_are_differences_through_lpf_2():
    positions = np.cumsum(np.random.default_rng(5).normal(0, 1e-5, 3000))
    found = estimates(FilterGains(300.0, 185.0), positions)
    sos = signal.butter(3, 185.0, fs=1 / DT_S, output="sos")
    errors = np.array([e.error_m for e in found])
    rates = signal.sosfilt(sos, np.diff(errors, prepend=errors[0]) / DT_S)
    accelerations = signal.sosfilt(sos, np.diff(rates, prepend=0.0) / DT_S)
    np.testing.assert_allclose([e.error_rate_m_per_s for e in found], rates, atol=1e-12)
    np.testing.assert_allclose(
        [e.error_acceleration_m_per_s2 for e in found], accelerations, atol=1e-9
    )


def test_the_derivatives_use_the_measured_dt():
    dts = [1e-3, 2e-3] * 2000
    times_s = np.cumsum(dts)
    found = estimates(FilterGains(20.0, 5.0), 0.02 * times_s, dts)
    assert found[-1].error_rate_m_per_s == pytest.approx(0.02, rel=5e-3)
    assert found[-2].error_rate_m_per_s == pytest.approx(0.02, rel=5e-3)


def test_open_loop_has_no_error_and_the_law_takes_over_without_a_jump():
    ticks = 100
    positions = 0.01 * np.sin(np.linspace(0, 3, 2 * ticks))
    asked = [OPEN_LOOP] * ticks + [reference(0.5)] * ticks
    found = estimates(FilterGains(300.0, 185.0), positions, DT_S, asked)
    for estimated in found[:ticks]:
        assert math.isfinite(estimated.position_filtered_m)
        assert math.isnan(estimated.error_m)
    first = found[ticks]
    assert first.error_m == pytest.approx(positions[ticks] - 0.5, abs=1e-3)
    assert first.error_rate_m_per_s == 0.0
    assert first.error_acceleration_m_per_s2 == 0.0
    speed = np.abs(np.diff(positions)).max() / DT_S
    assert max(abs(e.error_rate_m_per_s) for e in found[ticks:]) < 1.2 * speed


def test_the_filters_are_primed_again_every_time_the_law_takes_over():
    asked = ([OPEN_LOOP] * 5 + [reference(0.0)] * 5) * 2
    found = estimates(FilterGains(300.0, 185.0), 0.1 * DT_S * np.arange(20), DT_S, asked)
    assert [e.error_rate_m_per_s == 0.0 for e in found].count(True) == 2
    assert found[15].error_rate_m_per_s == found[15].error_acceleration_m_per_s2 == 0.0


@pytest.mark.parametrize("dt_s", [0.0, -1e-3, NAN])
def test_a_sample_with_an_invalid_dt_gives_finite_estimates(dt_s):
    for asked in (reference(0.0), OPEN_LOOP):
        last = estimates(FilterGains(300.0, 0.5), [0.0, 1e-3], [DT_S, dt_s], [asked] * 2)[-1]
        assert math.isfinite(last.position_filtered_m)
        assert math.isfinite(last.error_rate_m_per_s) == (asked is not OPEN_LOOP)
