"""The two low-pass filters and the derivatives, with the measured tick length.

Third-order Butterworth in trapezoidal form. Its states are integrator states, so the
coefficients may follow the measured dt from tick to tick without a jump. At a
constant dt it equals `scipy.signal.butter(3, cutoff, fs=1/dt)` sample by sample.
"""

from __future__ import annotations

from math import inf, isnan, nan, pi, tan
from typing import NamedTuple

from pamctl.signals import Estimate, Measurement, Reference

# Towards half the sampling rate the prewarped cut-off goes to infinity. Settings above this ratio
# are refused, so the limit acts only after missed ticks. The filter then passes the sample nearly
# unchanged, like any filter that is faster than the tick.
HIGHEST_PER_RATE = 0.45


class LowPass(NamedTuple):
    """State of one third-order Butterworth filter; NaN means not yet primed."""

    pole: float
    pair_rate: float
    pair_level: float


def prime_filter(value: float) -> LowPass:
    """Return the state of a filter whose input has always been `value`."""
    return LowPass(value, 0.0, value)


def warp_cutoff(cutoff_hz: float, dt_s: float) -> float:
    """Return tan(pi f dt), the cut-off for the trapezoidal rule."""
    per_rate = cutoff_hz * dt_s
    return tan(pi * (per_rate if per_rate < HIGHEST_PER_RATE else HIGHEST_PER_RATE))


def low_pass(state: LowPass, g: float, value: float) -> tuple[float, LowPass]:
    """Filter one sample with the warped cut-off `g`.

    A pole at -w in series with a pair of poles of quality 1 is the third-order Butterworth.
    """
    pole, pair_rate, pair_level = state
    rise = (value - pole) * g / (1.0 + g)
    first = pole + rise
    rate = (pair_rate + g * (first - pair_level)) / (1.0 + g * (1.0 + g))
    level = pair_level + g * rate
    return level, LowPass(first + rise, 2.0 * rate - pair_rate, 2.0 * level - pair_level)


class FilterGains(NamedTuple):
    """Cut-off frequencies: LPF_1 on the measured displacement, LPF_2 on the derivatives of e."""

    displacement_hz: float
    derivative_hz: float


class FilterState(NamedTuple):
    """The filters, and the last values that the difference quotients need."""

    position: LowPass
    rate: LowPass
    acceleration: LowPass
    error_m: float
    error_rate_m_per_s: float


_UNPRIMED_LOW_PASS = LowPass(nan, nan, nan)
UNPRIMED = FilterState(
    _UNPRIMED_LOW_PASS,
    _UNPRIMED_LOW_PASS,
    _UNPRIMED_LOW_PASS,
    nan,
    nan,
)


def estimate(
    gains: FilterGains,
    state: FilterState,
    measurement: Measurement,
    reference: Reference,
    dt_s: float,
) -> tuple[Estimate, FilterState]:
    """Filter the displacement, and differentiate the error twice.

    LPF_2 filters the derivatives of e = x - x_D. Filtering the derivatives of x, and subtracting
    the exact derivatives of x_D, would double the RMS error at the paper's 0.5 Hz.
    In open loop the reference is NaN, and so are the error and the states of its filters. They
    are primed again in the tick in which a law takes over.
    """
    if not dt_s > 0.0:
        # The sample is stale. It changes no state here, and safety trips on it.
        dt_s = inf
    g = warp_cutoff(gains.displacement_hz, dt_s)
    position = state.position
    if isnan(position.pole):
        position = prime_filter(measurement.position_m)
    position_m, position = low_pass(position, g, measurement.position_m)

    g = warp_cutoff(gains.derivative_hz, dt_s)
    error_m = position_m - reference.reference_m
    rate, acceleration = state.rate, state.acceleration
    last_m, last_m_per_s = state.error_m, state.error_rate_m_per_s
    if isnan(last_m):
        rate, acceleration = prime_filter(0.0), prime_filter(0.0)
        last_m, last_m_per_s = error_m, 0.0
    rate_m_per_s, rate = low_pass(rate, g, (error_m - last_m) / dt_s)
    change_m_per_s2 = (rate_m_per_s - last_m_per_s) / dt_s
    acceleration_m_per_s2, acceleration = low_pass(acceleration, g, change_m_per_s2)
    return (
        Estimate(position_m, measurement.pressure_pa, error_m, rate_m_per_s, acceleration_m_per_s2),
        FilterState(position, rate, acceleration, error_m, rate_m_per_s),
    )
