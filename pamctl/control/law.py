"""The contract of a control law. Read this file first; `pid.py` is the shortest example.

A law is one record, `Law`, in one module. An installed package offers its record under the
entry point group `pamctl.laws`; the shipped laws come through the same door:

    [project.entry-points."pamctl.laws"]
    super_twisting = "my_package.super_twisting:LAW"

Everything else reads the record: settings, loop, gain ramp, replay, tuning, report.

The kernel is called once in a tick while the loop is closed:

    (gains, memory, reference, estimate, dt_s) -> (command, memory)

- It is pure. It reads no clock, keeps no global state, and changes no argument.
- It must return within microseconds, and it must not raise for finite numbers.
- Gains and memory are NamedTuples of `float`, `int` and `bool`, and of such NamedTuples. The kernel
  is translated to C unchanged: it may call `math` and other plain functions of its package.
  `pamctl.kernel.translate` lists what it may use.
- The memory is all that the law remembers. It is `Law.armed` at the first tick and after every
  open-loop tick. It is frozen into the log under `law.<field>`, and a replay starts from it: a
  field that an old log lacks takes its value of `armed`.
- `estimate` is in SI, and `error = position - reference`. `Command.command_v` is in V: a positive
  command fills the muscle. The law keeps to `command_limit_v`, and safety comes after it:
  the settings that `Law.to_gains` gets hold the smaller of the law's limit and the rig's.
- `Command.surface_m_per_s2`, `equivalent_v` and `robust_v` are columns of the log. `Law.terms`
  says what they mean for this law. A term that the law does not have is NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import singledispatch
from math import isnan, nan
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args

from pydantic import Field

from hal.calibration import Configured
from pamctl.control.filters import FilterGains
from pamctl.signals import Command, Estimate, Reference

LengthUnit = Literal["mm", "inch"]
UNITS_PER_METRE: dict[str, float] = {"mm": 1000.0, "inch": 1.0 / 25.4e-3}

Cutoff = Annotated[float, Field(gt=0, le=1000)]


class LawSettings(Configured):
    """The keys of a gains file that every law has. A law adds its own, and `law: Literal[...]`.

    `length_unit` is the unit of e, and so of every gain: Eq. 15 is not homogeneous, so
    with other units the same numbers are another law.
    """

    if TYPE_CHECKING:
        law: str

    length_unit: LengthUnit
    lpf1_hz: Annotated[Cutoff, Field(description="LPF_1, on the displacement")] = 300.0
    lpf2_hz: Annotated[Cutoff, Field(description="LPF_2, on the derivatives of the error")]
    command_limit_v: Annotated[
        float,
        Field(
            gt=0,
            le=10,
            description="the law's own limit of u, either side of 0; `rig.limits.command_v` where "
            "that is less",
        ),
    ] = 5.0
    compensate: Annotated[
        tuple[str, ...],
        Field(description="effects of the plant file to undo, as `compensate` of a rig file"),
    ] = ()


BLENDED_BY_EVERY_LAW = frozenset({"lpf1_hz", "lpf2_hz", "command_limit_v"})

Gains = tuple[Any, ...]
"""A law's own NamedTuple of numbers for its kernel."""
Memory = tuple[Any, ...]
"""A law's own NamedTuple of numbers: all that it remembers from tick to tick."""
LawKernel = Callable[[Any, Any, Reference, Estimate, float], tuple[Command, Any]]


class Term(NamedTuple):
    """What a logged term of the command is called in reports."""

    symbol: str
    unit: str
    meaning: str = ""


class LawTerms(NamedTuple):
    """The meaning of the three columns that a law logs beside its command."""

    surface: Term | None
    """Column `surface_m_per_s2`; None for a law without a sliding surface."""
    equivalent: Term
    """Column `equivalent_v`."""
    robust: Term
    """Column `robust_v`."""


class GainAxis(NamedTuple):
    """One of the numbers that `pamctl tune` seeks, on a logarithmic scale."""

    name: str
    low: float
    high: float
    usual: float
    """Where a search begins by default."""


def read_numbers(gains: dict[str, Any]) -> dict[str, float]:
    """Return the numbers among the keys of a gains file."""
    return {name: float(value) for name, value in gains.items() if isinstance(value, int | float)}


class SearchSpace(NamedTuple):
    """What `pamctl tune` seeks, in mm, and what it keeps fixed."""

    fixed: dict[str, Any]
    """Keys of the gains file that every candidate has; `law` is among them."""
    axes: tuple[GainAxis, ...]
    to_gains: Callable[[dict[str, float]], dict[str, Any]] = dict
    """Turns the numbers of the axes into keys of a gains file."""
    from_gains: Callable[[dict[str, Any]], dict[str, float]] = read_numbers
    """Turns the keys of a gains file back into the numbers of the axes."""


@dataclass(frozen=True)
class Law:
    """One control law, complete. Raises ValueError where the parts do not fit together."""

    name: str
    """Its name in gains files and logs, as in `law: qsmc`."""
    title: str
    """Its name as people write it."""
    equation: str
    """The law as one line of text, for report and gains file."""
    settings: type[LawSettings]
    """The keys of its gains file, with bounds and `law: Literal[name]`."""
    gains: type[Gains]
    """The NamedTuple that its kernel takes. Each law has a type of its own."""
    to_gains: Callable[[Any], Gains]
    """Turns settings into gains: units converted once, and not in every tick."""
    kernel: LawKernel
    armed: Memory
    """The memory of a law that has just been switched on."""
    terms: LawTerms
    blended: frozenset[str] = field(default=frozenset())
    """Its settings that may change while the loop runs. All others change only between runs.

    The ramp interpolates the floats of the gains, and takes every other value at once.
    `lpf1_hz`, `lpf2_hz` and `command_limit_v` of every law may change.
    """
    search: SearchSpace | None = None
    """None: `pamctl tune` refuses this law."""

    def __post_init__(self) -> None:
        """Check what would otherwise fail in a loop or in the compiler."""
        keys = self.settings.model_fields
        if "law" not in keys or get_args(keys["law"].annotation) != (self.name,):
            raise ValueError(f"the settings of the law {self.name!r} lack law: Literal[its name]")
        unknown = self.blended - keys.keys()
        if unknown:
            raise ValueError(f"blended names {', '.join(sorted(unknown))}: not among the settings")
        if not _is_made_of_numbers(self.armed):
            raise ValueError("armed must be a NamedTuple of float, int and bool")
        if not hasattr(self.gains, "_fields"):
            raise ValueError("gains must be a NamedTuple type")

    def gains_within(self, settings: LawSettings, most_v: float) -> Gains:
        """Return the gains with the smaller of two limits: the law's own, and the rig's (V).

        A law that is not told of a clamp behind it winds up its integral.
        """
        limit_v = min(settings.command_limit_v, most_v)
        return self.to_gains(settings.model_copy(update={"command_limit_v": limit_v}))

    def may_blend(self, name: str) -> bool:
        """Tell whether a setting may change while the loop runs."""
        return name in self.blended or name in BLENDED_BY_EVERY_LAW


def _is_made_of_numbers(value: object) -> bool:
    if isinstance(value, tuple):
        return hasattr(value, "_fields") and all(map(_is_made_of_numbers, value))
    return isinstance(value, float | int)


def respond(
    gains: Gains,
    armed: Memory,
    memory: Memory,
    reference: Reference,
    estimate: Estimate,
    dt_s: float,
) -> tuple[Command, Memory]:
    """Let the law answer; a reference that is a valve command is passed on as it is.

    In open loop the law is kept armed: it takes over without a jump.
    """
    if not isnan(reference.reference_valve_v):
        return Command(reference.reference_valve_v, nan, 0.0, 0.0, False), armed
    return answer(gains, memory, reference, estimate, dt_s)


@singledispatch
def answer(
    gains: Any, memory: Memory, reference: Reference, estimate: Estimate, dt_s: float
) -> tuple[Command, Memory]:
    """Call the kernel of the law that the gains belong to: `pamctl.control.law_registry` adds it.

    Machine code calls that kernel directly.
    """
    raise TypeError(f"{type(gains).__name__}: the gains of no law that is installed")


def filter_gains(settings: LawSettings) -> FilterGains:
    """Return the filters that a gains file asks for."""
    return FilterGains(settings.lpf1_hz, settings.lpf2_hz)
