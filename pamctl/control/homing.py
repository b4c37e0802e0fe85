"""Homing: find what the sensors say of the vented muscle.

The encoder is incremental, and the pressure sensor's zero is good to 17 kPa only. So
the muscle is vented until both are steady, filled and vented again to settle the
braid, and what they then say becomes the zero of both.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated

from pydantic import Field

from hal.calibration import CalibrationSettings, Zero
from hal.configured import Configured
from hal.rig import RawSample
from pamctl.control.experiment import held
from pamctl.signals import Phase, Reference


class HomingSettings(Configured):
    """How to home, and when to give up."""

    enabled: Annotated[bool, Field(description="false: the first sample is the encoder's zero")] = (
        True
    )
    fills: Annotated[int, Field(ge=0, le=20)] = 2
    fill_v: Annotated[float, Field(gt=0, le=5)] = 2.0
    fill_s: Annotated[float, Field(gt=0, le=10)] = 0.15
    fill_rise_v: Annotated[
        float, Field(ge=0, le=5, description="sensor V that each fill must add; 0: do not look")
    ] = 0.02
    fill_counts: Annotated[
        int, Field(ge=0, description="encoder counts that each fill must add; 0: do not look")
    ] = 30
    vent_v: Annotated[float, Field(ge=-5, lt=0)] = -5.0
    steady_s: Annotated[float, Field(gt=0, le=10)] = 0.25
    steady_counts: Annotated[int, Field(ge=0, le=1000)] = 1
    steady_v: Annotated[float, Field(gt=0, le=1, description="sensor volts")] = 0.01
    timeout_s: Annotated[float, Field(gt=0, le=600, description="of each vent")] = 10.0


class HomingError(Exception):
    """The rig cannot be homed; the message says what was seen and what to check."""


class Homing:
    """Sequence of vents and fills; ends with the `Zero` of both sensors."""

    def __init__(self, settings: HomingSettings, calibration: CalibrationSettings) -> None:
        """`calibration` holds the electrical range that the sensor's zero must lie in."""
        self._settings = settings
        self._calibration = calibration
        self._fills_left = settings.fills
        self._filling = False
        self._since_s = 0.0
        self._before_fill: RawSample | None = None
        self._window: deque[tuple[float, RawSample]] = deque()
        self.zero: Zero | None = None

    def next(self, t_s: float, sample: RawSample) -> Reference | None:
        """Return what to do at `t_s` having seen `sample`, or None when homed.

        Raises `HomingError` where the rig does not come to rest, or rests at a sensor
        voltage that no vented sensor gives.
        """
        settings = self._settings
        if self._filling:
            if t_s - self._since_s < settings.fill_s:
                return held(Phase.HOMING, settings.fill_v)
            self._filling = False
            self._require_motion(sample)
            self._begin_vent(t_s)
        if not self._is_steady(t_s, sample):
            return held(Phase.HOMING, settings.vent_v)
        if self._fills_left:
            self._fills_left -= 1
            self._filling = True
            self._since_s = t_s
            self._before_fill = sample
            return held(Phase.HOMING, settings.fill_v)
        self.zero = self._mean_of_window()
        return None

    def _require_motion(self, sample: RawSample) -> None:
        """See that filling raised the pressure, and contracted the muscle: both by the sensors."""
        before, settings = self._before_fill, self._settings
        assert before is not None
        rise_v = sample.pressure_v - before.pressure_v
        counts = (sample.encoder_counts - before.encoder_counts) * self._calibration.encoder_sign
        if settings.fill_rise_v and not rise_v >= settings.fill_rise_v:
            raise HomingError(
                f"homing: filling changed the pressure sensor by {rise_v * 1e3:.0f} mV only; "
                "check the supply, the valve's sign and the sensor"
            )
        if settings.fill_counts and counts < settings.fill_counts:
            raise HomingError(
                f"homing: filling moved the encoder by {counts} counts; check its wiring, its "
                "supply and `encoder_sign`"
            )

    def _begin_vent(self, t_s: float) -> None:
        self._since_s = t_s
        self._window.clear()

    def _is_steady(self, t_s: float, sample: RawSample) -> bool:
        settings, window = self._settings, self._window
        window.append((t_s, sample))
        while window[0][0] < t_s - settings.steady_s:
            window.popleft()
        if t_s - self._since_s < settings.steady_s:
            return False
        counts = [seen.encoder_counts for _, seen in window]
        half = len(window) // 2
        volts = [seen.pressure_v for _, seen in window]
        drift_v = abs(math.fsum(volts[half:]) / len(volts[half:]) - _mean(volts[:half]))
        if max(counts) - min(counts) <= settings.steady_counts and drift_v <= settings.steady_v:
            return True
        if t_s - self._since_s > settings.timeout_s:
            raise HomingError(
                f"homing: still moving {settings.timeout_s:g} s after venting (encoder over "
                f"{max(counts) - min(counts)} counts, sensor drift {drift_v * 1e3:.1f} mV in "
                f"{settings.steady_s:g} s); check the exhaust and the encoder"
            )
        return False

    def _mean_of_window(self) -> Zero:
        sensor_v = _mean([seen.pressure_v for _, seen in self._window])
        lowest = self._calibration.sensor_zero_lowest_v
        highest = self._calibration.sensor_zero_highest_v
        if not lowest <= sensor_v <= highest:
            raise HomingError(
                f"homing: the vented pressure sensor gives {sensor_v:.3f} V, outside "
                f"{lowest:g} to {highest:g} V; check that the muscle is vented and the "
                "sensor's supply and wiring"
            )
        return Zero(sensor_v, float(self._window[-1][1].encoder_counts))


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan
