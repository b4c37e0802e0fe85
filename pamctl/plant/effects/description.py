"""What a reader, a plant file and the diagnosis need to know of an effect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Block = Literal["pressure", "mechanics", "sensors"]
Part = Literal["command", "valve", "air", "mechanics", "sensors"]
"""The parts of a step; each takes notice of effects only where one of its own acts."""


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect.

    A `size` at its neutral value (0 or 1) switches the effect off exactly. A `shape` says how
    an effect acts that is on, and does nothing by itself.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    smallest_of_interest: float
    meaning: str
    start: float = 0.0
    """Where a fit may start: off every bound, and large enough to be felt."""
    role: Literal["size", "shape"] = "size"
    choices: tuple[str, ...] = ()
    """Names of the whole numbers from 0 on, where the number chooses among forms."""


def size(
    name: str,
    unit: str,
    high: float,
    *,
    smallest: float,
    start: float,
    meaning: str,
    neutral: float = 0.0,
    low: float = 0.0,
) -> EffectParameter:
    """Describe a number that switches its effect on."""
    return EffectParameter(name, unit, neutral, low, high, smallest, meaning, start)


def shape(
    name: str,
    unit: str,
    low: float,
    high: float,
    *,
    usual: float,
    smallest: float,
    meaning: str,
    choices: tuple[str, ...] = (),
) -> EffectParameter:
    """Describe a number that says how an effect acts which is on; `usual` where nobody says."""
    return EffectParameter(
        name, unit, usual, low, high, smallest, meaning, usual, role="shape", choices=choices
    )


@dataclass(frozen=True)
class EffectForm:
    """One of several forms of an effect: what a fit holds, and what it frees."""

    name: str
    free: tuple[str, ...]
    held: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class EffectDescription:
    """One entry of the catalogue."""

    name: str
    block: Block
    """Where it enters."""
    equation: str
    parameters: tuple[EffectParameter, ...]
    signature: str
    """What it does to simulation minus measurement when the model lacks it."""
    best_experiment: str
    parts: tuple[Part, ...]
    """The parts of the step that compute it."""
    seen_by: tuple[Block, ...]
    """The blocks whose residual shows it when each is driven by the other's measured signal."""
    forms: tuple[EffectForm, ...] = ()
    """Empty: one form, all parameters free."""
    identifiable: bool = True
    """False where no experiment on this rig can tell its size."""


def acts(effect: EffectDescription, values: Mapping[str, float]) -> bool:
    """Tell whether any size among an effect's parameters (by name) is off its neutral value."""
    return any(
        values.get(p.name, p.neutral) != p.neutral for p in effect.parameters if p.role == "size"
    )
