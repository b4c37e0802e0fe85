"""The right answer of a case, in words that a diagnosis's document can be compared with."""

from __future__ import annotations

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


@dataclass(frozen=True)
class SetupCause:
    """Something of the set-up that is not as stated."""

    kind: Kind
    number: str = ""
    """A plant number or a channel; empty: the kind says all."""
    value: float | None = None
    """The true value (or the change, as a share), for the report only."""


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
