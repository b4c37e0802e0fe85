"""What is wrong in a laboratory: with the rig over time, with its clock, its wires and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Channel = Literal["valve_v", "pressure_pa", "position_m"]


@dataclass(frozen=True)
class Lab:
    """Every field is off by default: a laboratory whose user knows all of it. SI."""

    # --- the rig, beyond its effects
    truth: Mapping[str, float] = field(default_factory=dict)
    """Numbers of the truth, set."""
    truth_factors: Mapping[str, float] = field(default_factory=dict)
    within: Mapping[str, float] = field(default_factory=dict)
    """Numbers of the truth that change by this share, evenly from start to end of each record."""
    between: Mapping[str, float] = field(default_factory=dict)
    """Numbers that change by this share, evenly from the first record to the last."""
    at_half: Mapping[str, float] = field(default_factory=dict)
    """Numbers that take this value from half of each record on."""
    at_half_factors: Mapping[str, float] = field(default_factory=dict)

    # --- what the user believes
    plant_factors: Mapping[str, float] = field(default_factory=dict)
    """Numbers of the plant file that are wrong by this factor."""
    plant: Mapping[str, float] = field(default_factory=dict)
    """Numbers of the plant file that are set."""
    true_atmosphere_pa: float = 101.3e3
    sensor_is_gauge: bool = False
    """The file's absolute pressure is the gauge sensor's and the atmosphere of the plant file."""

    # --- time
    late_s: Mapping[Channel, float] = field(default_factory=dict)
    """A column shows what was this long ago; below 0: what will be."""
    clock_rates: Mapping[Channel, float] = field(default_factory=dict)
    """A column is recorded by a clock that is faster by this share."""
    time_rate: float = 0.0
    """The clock of all columns is faster by this share."""
    jittered_stamps_s: float = 0.0
    """Samples are regular; the software stamps them with this standard deviation."""
    decimation: int = 1
    """Of the command: each value is logged once in so many rows, and held."""

    # --- signs, scales, zeros
    inverted: tuple[Channel, ...] = ()
    position_scale: float = 1.0
    pressure_zero_shift_pa: float = 0.0
    """Added to the column: -101.3e3 for a gauge pressure that is taken for absolute."""
    pressure_bow: float = 0.0
    """Nonlinearity of the sensor: the deviation in the middle, as a share of full scale."""

    # --- noise
    filter_hz: float = 0.0
    """The user filtered forward and backward (zero phase) offline."""
    hum_hz: float = 0.0
    hum_pa: float = 0.0
    hum_m: float = 0.0
    spikes: float = 0.0
    """Share of the rows that have one."""
    spike_pa: float = 0.0
    spike_m: float = 0.0
    dropouts: float = 0.0
    """Share of the rows in which a dropout begins: 1 to 3 rows of zero gauge pressure."""
    noise_with_flow: float = 0.0
    """The noise's standard deviation at the greatest flow, in those at rest, less one."""
    wander_pa: float = 0.0
    wander_s: float = 5.0
    adc_bits: int = 0
    """Above 0: of the pressure (0 to 700 kPa) and of an analog position (0 to 25.6 mm)."""
