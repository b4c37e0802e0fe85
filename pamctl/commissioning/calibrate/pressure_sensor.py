"""The pressure sensor: its zero at the atmosphere, its gain against a reference gauge."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pamctl.commissioning.calibrate.holding import read_while_held
from pamctl.commissioning.calibrate.outcome import (
    CalibrationError,
    CalibrationOutcome,
    CalibrationValue,
    Operator,
    list_residuals,
    require_near,
    slope,
    slope_uncertainty,
)
from pamctl.commissioning.hands_on import Bench, SensorStatistics

DEFAULT_POINTS_KPA = (100.0, 200.0, 300.0)
_CODE_V = 10.0 / 65536
"""One code of a +-5 V input: the resolution."""
_CORRELATED = 4.0
"""How much noisier the mean of a held pressure is than that of a pressure at rest: the hold follows
the sensor's noise, which stays correlated over 14 samples."""
_WORST_SHARE = 0.03
"""Residual over the highest reading, above which the points do not lie on a line."""
_HINTS = {
    1.0 / 6.895: "were the readings in psi? They must be kPa",
    0.01: "were the readings in bar? They must be kPa",
    0.001: "were the readings in MPa? They must be kPa",
    1000.0: "were the readings in Pa? They must be kPa",
}


def calibrate_pressure(
    bench: Bench, operator: Operator, points_kpa: Sequence[float]
) -> CalibrationOutcome:
    """Vent and take the zero; hold each pressure (kPa gauge) and ask what the gauge reads.

    Raises `CalibrationError` or `LimitError`.
    """
    zero = _measure_zero(bench)
    volts, readings_pa, noises_v = [], [], []
    for point_kpa in points_kpa:
        held, reading_kpa = read_while_held(
            bench,
            operator,
            point_kpa,
            "what does the reference gauge read, in kPa (gauge)?",
        )
        if not (math.isfinite(reading_kpa) and reading_kpa > 0.0):
            raise CalibrationError(f"a gauge under pressure cannot read {reading_kpa:g} kPa")
        volts.append(held.sensor_v - zero.sensor_v)
        readings_pa.append(reading_kpa * 1e3)
        noises_v.append(math.hypot(_mean_noise_v(zero), _CORRELATED * _mean_noise_v(held)))
    bench.hold(bench.safe_valve_v, bench.period_s)
    zero_value = CalibrationValue(
        ("calibration", "sensor_zero_v"),
        round(zero.sensor_v, 6),
        "V",
        2.0 * _mean_noise_v(zero),
        f"mean of {zero.samples} samples at the atmosphere, noise {zero.noise_v * 1e3:.2f} mV",
    )
    figures = {"zero": zero._asdict(), "sensor_v": volts, "reading_pa": readings_pa}
    if not points_kpa:
        return CalibrationOutcome((zero_value,), (), figures)
    gain, residuals_pa = _fit_gain(bench, volts, readings_pa)
    return CalibrationOutcome(
        (
            zero_value,
            CalibrationValue(
                ("calibration", "sensor_pa_per_v"),
                round(gain, 2),
                "Pa/V",
                slope_uncertainty(gain, volts, residuals_pa, max(noises_v)),
                f"gauge at {', '.join(f'{p * 1e-3:g}' for p in readings_pa)} kPa, residuals "
                f"{', '.join(f'{r * 1e-3:+.2f}' for r in residuals_pa)} kPa",
            ),
        ),
        (),
        {**figures, "residual_pa": residuals_pa},
    )


def _measure_zero(bench: Bench) -> SensorStatistics:
    cal = bench.settings
    zero = bench.settle(bench.homing.vent_v, averaged_s=1.0)
    lowest, highest = cal.sensor_zero_lowest_v, cal.sensor_zero_highest_v
    if not lowest <= zero.sensor_v <= highest:
        raise CalibrationError(
            f"the vented sensor gives {zero.sensor_v:.3f} V, outside {lowest:g} to {highest:g} V; "
            "check that the muscle is vented, and the sensor's supply and wiring"
        )
    return zero


def _fit_gain(
    bench: Bench, volts: Sequence[float], readings_pa: Sequence[float]
) -> tuple[float, list[float]]:
    """Fit a line through the zero at the atmosphere; return its slope and its residuals."""
    gain = slope(volts, readings_pa)
    require_near("sensor_pa_per_v", gain, bench.settings.sensor_pa_per_v, _HINTS)
    residuals = list_residuals(volts, readings_pa, gain)
    if max(map(abs, residuals)) > _WORST_SHARE * max(readings_pa):
        shown = ", ".join(f"{residual * 1e-3:+.1f}" for residual in residuals)
        raise CalibrationError(
            f"the readings do not lie on a line through zero (residuals {shown} kPa); was one "
            "mistyped, or read as absolute pressure?"
        )
    return gain, residuals


def _mean_noise_v(rest: SensorStatistics) -> float:
    return math.hypot(rest.mean_noise_v, _CODE_V / math.sqrt(12.0))
