"""What a reader, a plant file and the diagnosis need to know of an effect."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect. `neutral` switches it off exactly."""

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    smallest_of_interest: float
    meaning: str


@dataclass(frozen=True)
class EffectDescription:
    """One entry of the catalogue."""

    name: str
    block: str
    """Where it enters: `pressure`, `mechanics` or `sensors`."""
    equation: str
    parameters: tuple[EffectParameter, ...]
    signature: str
    """What it does to simulation minus measurement when the model lacks it."""
    best_experiment: str
