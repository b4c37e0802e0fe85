"""What an effect is: its numbers, its kernels and where they enter, and what a reader must know.

An effect is one record beside its kernels. Everything else is derived from it: the plant file, the
steps of the plant, the search of `pamctl diagnose`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, get_args

from pamctl.plant.effects.places import PLACES, Part

if TYPE_CHECKING:
    from pamctl.plant.paper import PaperParameters

MECHANICAL_UNITS = frozenset(
    {"N", "m", "m/s", "kg", "N/m", "N/m3", "m/N", "N s/m", "N/Pa", "N s/(m Pa)", "m2", "m3"}
)
"""Units of numbers whose size follows the machine's: its force, travel, speed and pressure."""

UNDOABLE_PLACES = ("command", "opening", "pressure_reading", "position_reading")
"""Where a tick can undo an effect: before the valve, and behind the sensors."""

Block = Literal["pressure", "mechanics", "sensors"]
Actuator = Literal["muscle", "direct", "chamber", "cylinder"]
"""What a plant file calls `actuator`.

A muscle; a force that drives the mechanics directly; a chamber of constant volume, which has no
mechanics; a cylinder whose piston the pressure pushes.
"""
ACTUATORS: tuple[Actuator, ...] = get_args(Actuator)
USED_SIGNALS: Mapping[Actuator, tuple[str, ...]] = {
    "muscle": ("valve_v", "pressure_pa", "position_m"),
    "direct": ("force_n", "pressure_pa", "position_m"),
    "chamber": ("valve_v", "pressure_pa"),
    "cylinder": ("valve_v", "pressure_pa", "position_m"),
}
"""The measured signals that an actuator's model reads."""


def describe_unused(signal: str, actuator: Actuator) -> str:
    """Say that a measured signal is not used, and which are."""
    used = ", ".join(USED_SIGNALS[actuator])
    return f"{signal} is not used: a model with `actuator: {actuator}` reads {used}"


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect.

    A `size` at its neutral value (0 or 1) switches the effect off exactly. A `shape` says how
    an active effect acts, and does nothing by itself.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    smallest_of_interest: float
    meaning: str
    start: float = 0.0
    """Where a fit may start: inside the bounds, and large enough to be seen."""
    role: Literal["size", "shape"] = "size"
    choices: tuple[str, ...] = ()
    """Names of the values 0, 1, ... of a number that selects a form."""

    @property
    def is_scaled(self) -> bool:
        """Tell whether its range grows with the machine: a force or a length, no ratio or time.

        `low` and `high` are then those of the paper's muscle. They limit a fit on such a muscle,
        and no plant file.
        """
        return self.unit in MECHANICAL_UNITS


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
    """One of several forms of an effect: the numbers that a fit holds, and those that it frees."""

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

    The kernel's first argument is the effect's parameters. It names the others: any of
    those of its place (`pamctl.plant.effects.places`), in any order. It is also called at neutral
    values, and must then return its value unchanged, or 0 if results are added up.
    A kernel with a memory is called only where its effect acts.
    """

    place: str
    kernel: Callable[..., Any]
    memory: EffectMemory | None = None
    after: tuple[str, ...] = ()
    """Effects of the same place that must act before this kernel."""
    undo: Callable[..., Any] | None = None
    """The inverse of the kernel; None if the effect cannot be undone.

    For a reading: (parameters, readings, times_s, atmosphere_pa) -> the readings of a sensor
    without the effect, all arrays. It may add noise.
    For `command` and `opening`: (parameters, passed_v) -> the value that the kernel turns into
    `passed_v`, both V. Where several do it is the one nearest null, and where none does the one
    that comes nearest. It is called when a run is set up, never in a tick
    (`pamctl.settings.known_effects`).
    """


@dataclass(frozen=True)
class AsTerm:
    """A term that an effect is, or is akin to; `pamctl.plant.terms` has its words."""

    location: str
    operator: str
    driver: str = ""
    """A constant has none."""


@dataclass(frozen=True)
class Distinction:
    """How to distinguish two effects."""

    experiment: str
    """Name of an experiment file."""
    why: str


@dataclass(frozen=True, kw_only=True)
class EffectDescription:
    """One entry of the catalogue."""

    kind: type[Any]
    """NamedTuple of the parameters, whose defaults are neutral."""
    name: str = ""
    """By default that of `kind`, in small letters: `valve_leak` of `ValveLeak`."""
    block: Block
    """The block that it belongs to, for readers only."""
    equation: str
    parameters: tuple[EffectParameter, ...]
    signature: str
    """How simulation minus measurement looks when the model lacks the effect."""
    best_experiment: str = ""
    """Name of the muscle's experiment file that shows it best; empty where none does."""
    seen_by: tuple[Block, ...] = ()
    """The blocks whose residual shows it when each is driven by the other's measured signal; by
    default its own."""
    entries: tuple[EffectEntry, ...] = ()
    """Where it enters the plant."""
    woven: tuple[Part, ...] = ()
    """Parts whose equations call its kernels by name, because a step is solved with them."""
    forms: tuple[EffectForm, ...] = ()
    """Empty: one form, all parameters free."""
    told_from: Mapping[str, Distinction] = field(default_factory=dict)
    """How to distinguish it from other effects, by name; each pair appears once."""
    unidentifiable: Callable[[PaperParameters], str] | None = None
    """Says why `diagnose` does not fit its size, from the plant's numbers; None where it does."""
    same_as: Mapping[Actuator, tuple[str, ...]] = field(default_factory=dict)
    """By actuator, numbers of the plant that do the same together: unless one of them is known and
    not 0, no record shows the effect."""
    as_terms: tuple[AsTerm, ...] = ()
    """The terms that say it without its name."""
    actuators: tuple[Actuator, ...] = ACTUATORS
    """The actuators in whose plants `diagnose` looks for it; a plant file may always hold it."""

    def __post_init__(self) -> None:
        """Fill in what follows from the rest."""
        words = re.findall("[A-Z][^A-Z]*", self.kind.__name__)
        object.__setattr__(self, "name", self.name or "_".join(words).lower())
        object.__setattr__(self, "seen_by", self.seen_by or (self.block,))

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts of a step that compute it."""
        entered = {PLACES[entry.place].part for entry in self.entries}
        return tuple(sorted({*entered, *self.woven}))

    @property
    def is_undoable(self) -> bool:
        """Tell whether a tick can undo it: each kernel has an inverse, and none a memory."""
        return (
            bool(self.entries)
            and not self.woven
            and all(
                entry.place in UNDOABLE_PLACES and entry.undo is not None and entry.memory is None
                for entry in self.entries
            )
        )


def acts(effect: EffectDescription, values: Mapping[str, float]) -> bool:
    """Return whether any size among an effect's parameters (by name) is off its neutral value."""
    return any(
        values.get(p.name, p.neutral) != p.neutral for p in effect.parameters if p.role == "size"
    )
