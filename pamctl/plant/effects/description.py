"""What an effect is: its numbers, its kernels and where they enter, and what a reader must know.

An effect is one file with one record, `DESCRIPTION`. Whatever else the program knows of effects
(the plant file, the steps of the plant, the search of `pamctl diagnose`) is derived from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pamctl.plant.effects.places import PLACES, Part

Block = Literal["pressure", "mechanics", "sensors"]


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
    """Describe a number that says how an effect acts; `usual` is its value by default."""
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
class EffectMemory:
    """What an effect remembers from step to step: a NamedTuple of floats."""

    at_rest: Callable[[float, float], Any]
    """Memory after a long rest at a position (m) and an absolute pressure (Pa)."""
    follow: Callable[..., Any]
    """Kernel that returns the memory after a step. It names its arguments: see `Place.follows`."""


@dataclass(frozen=True)
class EffectEntry:
    """A kernel of an effect and the place in the plant where it enters.

    The kernel's first argument is the effect's parameters. It names the others: those of its
    place (`pamctl.plant.effects.places`), in any order and only those that it needs. It is
    called at neutral values, too, and must then return its value, or 0 where results are added up.
    A kernel with a memory is called only where its effect acts.
    """

    place: str
    kernel: Callable[..., Any]
    memory: EffectMemory | None = None
    after: tuple[str, ...] = ()
    """Effects of the same place whose result this kernel takes."""
    undo: Callable[..., Any] | None = None
    """For a reading: (parameters, readings, times_s, atmosphere_pa) -> what a sensor without the
    effect would have shown, all arrays. It may add noise; None where nothing can be undone."""


@dataclass(frozen=True)
class Distinction:
    """How an effect is told from another one."""

    experiment: str
    """Name of an experiment file."""
    why: str


@dataclass(frozen=True)
class EffectDescription:
    """One entry of the catalogue."""

    name: str
    kind: type[Any]
    """NamedTuple of the parameters, whose defaults are neutral."""
    block: Block
    """The block that it belongs to, for the reader."""
    equation: str
    parameters: tuple[EffectParameter, ...]
    signature: str
    """What it does to simulation minus measurement when the model lacks it."""
    best_experiment: str
    """Name of the experiment file that shows it best; empty where none does."""
    seen_by: tuple[Block, ...]
    """The blocks whose residual shows it when each is driven by the other's measured signal."""
    entries: tuple[EffectEntry, ...] = ()
    """Where it enters the plant."""
    woven: tuple[Part, ...] = ()
    """Parts whose equations call its kernels by name, because a step is solved with them."""
    forms: tuple[EffectForm, ...] = ()
    """Empty: one form, all parameters free."""
    told_from: Mapping[str, Distinction] = field(default_factory=dict)
    """How it is told from other effects, by their names; once for each pair."""
    unidentifiable: str = ""
    """Why no experiment on this rig can tell its size; empty where one can."""
    is_searched: bool = True
    """False where `diagnose` must not name it: it would explain too much."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts of a step that compute it."""
        entered = {PLACES[entry.place].part for entry in self.entries}
        return tuple(sorted({*entered, *self.woven}))


def acts(effect: EffectDescription, values: Mapping[str, float]) -> bool:
    """Tell whether any size among an effect's parameters (by name) is off its neutral value."""
    return any(
        values.get(p.name, p.neutral) != p.neutral for p in effect.parameters if p.role == "size"
    )
