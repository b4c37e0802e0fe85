"""Homing: find the zeros of both sensors on the vented muscle.

The encoder is incremental, and the pressure sensor's zero is uncertain by 17 kPa. So the muscle is
vented until both sensors are steady. Then it is filled and vented again to settle the braid. The
readings after that are the zeros.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from hal.calibration import CalibrationSettings, Configured, Zero
from hal.rig import RawSample
from pamctl.base.texts import count_of
from pamctl.control.course import make_valve_reference
from pamctl.signals import Phase, Reference


class HomingSettings(Configured):
    """How the muscle is homed, and when homing fails."""

    enabled: Annotated[bool, Field(description="false: the first sample is the encoder's zero")] = (
        True
    )
    fills: Annotated[int, Field(ge=0, le=20)] = 2
    fill_v: Annotated[float, Field(gt=0, le=5)] = 2.0
    fill_s: Annotated[float, Field(gt=0, le=10)] = 0.15
    fill_rise_v: Annotated[
        float, Field(ge=0, le=5, description="sensor V that each fill must add; 0: no check")
    ] = 0.02
    fill_counts: Annotated[
        int, Field(ge=0, description="encoder counts that each fill must add; 0: no check")
    ] = 30
    vent_v: Annotated[float, Field(ge=-5, lt=0)] = -5.0
    steady_s: Annotated[float, Field(gt=0, le=10)] = 0.25
    steady_counts: Annotated[int, Field(ge=0, le=1000)] = 1
    steady_v: Annotated[float, Field(gt=0, le=1, description="sensor volts")] = 0.01
    timeout_s: Annotated[float, Field(gt=0, le=600, description="limit of each vent")] = 10.0


class HomingError(Exception):
    """The rig cannot be homed; the message gives the observation and what to check."""


class _Block:
    """Half of the steady time, with the sensors' mean and range in it."""

    def __init__(self, begin_s: float) -> None:
        self.begin_s = begin_s
        self.samples = 0
        self.sum_v = 0.0
        self.lowest_counts = math.inf
        self.highest_counts = -math.inf

    def take(self, sample: RawSample) -> None:
        self.samples += 1
        self.sum_v += sample.pressure_v
        self.lowest_counts = min(self.lowest_counts, sample.encoder_counts)
        self.highest_counts = max(self.highest_counts, sample.encoder_counts)

    @property
    def mean_v(self) -> float:
        return self.sum_v / self.samples


class Homing:
    """Sequence of vents and fills; ends with the `Zero` of both sensors."""

    def __init__(self, settings: HomingSettings, calibration: CalibrationSettings) -> None:
        """`calibration` holds the permitted voltage range of the sensor's zero."""
        self._settings = settings
        self._calibration = calibration
        self._fills_left = settings.fills
        self._filling = False
        self._since_s = 0.0
        self._before_fill: RawSample | None = None
        self._blocks: list[_Block] = []
        self.zero: Zero | None = None

    def next_reference(self, t_s: float, sample: RawSample) -> Reference | None:
        """Return the reference at `t_s` after `sample`, or None when homed.

        Raises `HomingError` if the rig does not come to rest, does not react to a fill, or rests at
        a sensor voltage outside the permitted range.
        """
        settings = self._settings
        if self._filling:
            if t_s - self._since_s < settings.fill_s:
                return make_valve_reference(Phase.HOMING, settings.fill_v)
            self._filling = False
            self._require_motion(sample)
            self._since_s = t_s
            self._blocks.clear()
        if not self._is_steady(t_s, sample):
            return make_valve_reference(Phase.HOMING, settings.vent_v)
        if self._fills_left:
            self._fills_left -= 1
            self._filling = True
            self._since_s = t_s
            self._before_fill = sample
            return make_valve_reference(Phase.HOMING, settings.fill_v)
        self.zero = self._take_zero(sample)
        return None

    @property
    def holds_until_s(self) -> float:
        """Until when it asks for the same, whatever the sensors show."""
        if self._filling:
            return self._since_s + self._settings.fill_s
        return self._blocks[-1].begin_s + 0.5 * self._settings.steady_s if self._blocks else 0.0

    def take(self, sample: RawSample) -> None:
        """Take a sample of a tick that did not ask, before `holds_until_s`."""
        if not self._filling:
            self._blocks[-1].take(sample)

    def _require_motion(self, sample: RawSample) -> None:
        """Check by the sensors that filling raised the pressure and contracted the muscle."""
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
                f"homing: filling moved the encoder by {count_of(counts, 'count')}; check "
                "its wiring, its supply and `encoder_sign`"
            )

    def _is_steady(self, t_s: float, sample: RawSample) -> bool:
        """Compare the last two halves of the steady time when one is complete."""
        blocks = self._blocks
        if not blocks:
            blocks.append(_Block(t_s))
        complete = t_s - blocks[-1].begin_s >= 0.5 * self._settings.steady_s
        if not complete:
            blocks[-1].take(sample)
            return False
        if len(blocks) >= 2:
            drift_v, counts = _drift(*blocks[-2:])
            if drift_v <= self._settings.steady_v and counts <= self._settings.steady_counts:
                return True
        if t_s - self._since_s > self._settings.timeout_s:
            raise HomingError(self._describe_unrest())
        self._blocks = [blocks[-1], _Block(t_s)]
        self._blocks[-1].take(sample)
        return False

    def _describe_unrest(self) -> str:
        drift_v, counts = _drift(self._blocks[0], self._blocks[-1])
        return (
            f"homing: still moving {self._settings.timeout_s:g} s after venting (encoder over "
            f"{counts:g} counts, sensor drift {drift_v * 1e3:.1f} mV in "
            f"{self._settings.steady_s:g} s); check the exhaust and the encoder"
        )

    def _take_zero(self, sample: RawSample) -> Zero:
        blocks = self._blocks[-2:]
        sensor_v = sum(block.sum_v for block in blocks) / sum(block.samples for block in blocks)
        lowest = self._calibration.sensor_zero_lowest_v
        highest = self._calibration.sensor_zero_highest_v
        if not lowest <= sensor_v <= highest:
            raise HomingError(
                f"homing: the vented pressure sensor gives {sensor_v:.3f} V, outside "
                f"{lowest:g} to {highest:g} V; check that the muscle is vented and the "
                "sensor's supply and wiring"
            )
        return Zero(sensor_v, float(sample.encoder_counts))


def _drift(first: _Block, second: _Block) -> tuple[float, float]:
    """Return the change of the sensor's mean (V), and the range of the encoder (counts)."""
    lowest = min(first.lowest_counts, second.lowest_counts)
    highest = max(first.highest_counts, second.highest_counts)
    return abs(second.mean_v - first.mean_v), highest - lowest
