"""What is wrong in a laboratory (rig, clock, wires, file), and what must be said of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Kind = Literal[
    "plant_constant", "null_offset", "sign", "skew", "clock_rate", "decimated_command", "scale",
    "gauge", "bow", "drift", "change_at_instant",
]  # fmt: skip

NOISE_WORDS = {
    "filtered": r"filter|zero.?phase|non.?causal|smooth",
    "hum": r"\bhum|hum\b|mains|line",
    "outliers": r"outlier|spike",
    "dropouts": r"drop.?out|outlier|spike",
    "jitter": r"jitter|stamp",
    "wander": r"wander|slow|drift|1/f",
    "flow": r"flow|moving|motion|speed|grows",
    "coarse": r"quant|coarse|bits|step",
}
"""A fault of the noise, and how a document may call it."""

FITTED = frozenset({
    "valve_gain_m2_per_v", "tank_pressure_pa", "damping_n_s_per_m", "stiffness_n_per_m",
    "kinetic_friction_per_m", "braid_length_m",
})  # fmt: skip
"""Numbers that are really off by a few per cent in every rig: to find them is never false."""

TRUTH_NAMES = {
    "mass_kg": "mass_kg",
    "damping_n_s_per_m": "damping",
    "stiffness_n_per_m": "stiffness",
    "rest_length_m": "rest_length_m",
    "braid_length_m": "braid_m",
    "braid_turns": "turns",
    "kinetic_friction_per_m": "mu_k",
    "braid_contact_area_m2": "contact_m2",
    "tank_pressure_pa": "supply_pa",
    "atmospheric_pressure_pa": "atmosphere_pa",
    "temperature_k": "wall_k",
    "valve_gain_m2_per_v": "valve_m2_per_v",
}
"""A number's name in the plant file, and in the truth."""


@dataclass(frozen=True)
class SetupCause:
    """Something of the set-up that is not as stated."""

    kind: Kind
    number: str = ""
    """A plant number or a channel; empty: the kind says all."""


@dataclass(frozen=True)
class Answer:
    """What a diagnosis may say of a case.

    All of `effects`, of `setup` and of `noise` are to be said. What is said beyond them is false,
    except: `equal` (the same equation under another name: alone it is a twin of the answer),
    `beside` (cannot be told from the truth, but is no name without it).
    """

    effects: frozenset[str] = frozenset()
    setup: tuple[SetupCause, ...] = ()
    noise: tuple[str, ...] = ()
    """Words of `NOISE_WORDS`."""
    silent: bool = False
    """A verdict that names nothing is right as well."""
    unknown: bool = False
    """No catalogue has it: that no known effect explains it is the right answer."""
    refusal: tuple[str, ...] = ()
    """Refused for a reason that holds one of these words, it is right as well."""
    equal: frozenset[str] = frozenset()
    beside: frozenset[str] = frozenset()
    also: tuple[SetupCause, ...] = field(default=())
    """Set-up findings that are true besides, or the same equation; they need not be said."""


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
