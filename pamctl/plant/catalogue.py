"""Load all effects, shipped and outside ones, and compose them: one kernel a place.

An entry point of the group `pamctl.effects` names a record (`my_package.my_effect:DESCRIPTION`), a
module that holds records, or a package of such modules. The shipped effects are such a package. It
is always loaded, also where an old installation does not declare it.

An outside effect that cannot be loaded is left out with a warning: a broken package must not keep
the valve from its safe voltage. A plant file that names it is refused as for any unknown effect.

Machine code is made of functions with a fixed source, so each place gets one that calls the
effects' kernels by name:

    def pass_opening(effects, memory, opening_v, age_s):
        opening_v = valve_deadband_kernel(effects.valve_deadband, opening_v)
        opening_v = valve_curve_kernel(effects.valve_curve, opening_v)
        ...
        return opening_v

A kernel without a memory is always called: a test before each call would cost the compiled plant
12 %. At neutral values it must therefore return its value unchanged, or add 0. A kernel with a
memory is called, and its memory updated, only if the effect is active.
"""

from __future__ import annotations

import pkgutil
import warnings
from collections import namedtuple
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import cache, lru_cache
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.metadata import EntryPoint
from math import nan
from types import ModuleType
from typing import Any, NamedTuple

from hal.entry_points import find_entry_points
from pamctl.kernel.calls import note_composed
from pamctl.plant.effects.description import EffectDescription, EffectEntry
from pamctl.plant.effects.places import PLACES, Part
from pamctl.plant.terms import TERMS

GROUP = "pamctl.effects"
SHIPPED = EntryPoint("shipped", "pamctl.plant.effects", GROUP)
BLOCKS = ("pressure", "mechanics", "sensors")


def load_effects() -> dict[str, EffectDescription]:
    """Load the effects of all entry points, by name; the shipped ones first in each block."""
    found: dict[str, EffectDescription] = {}
    for point in [SHIPPED, *(p for p in find_entry_points(GROUP) if p.value != SHIPPED.value)]:
        try:
            for effect in _list_effects(point.load()):
                check_effect(effect)
                if effect.name in found:
                    raise ValueError(f"an effect of the name {effect.name} exists already")
                found[effect.name] = effect
        except Exception as error:
            if point is SHIPPED:
                raise
            package = f" of {point.dist.name} {point.dist.version}" if point.dist else ""
            warnings.warn(
                f"effect {point.name}{package} is left out: {point.value}: {error}",
                RuntimeWarning,
                stacklevel=2,
            )
    return dict(sorted(found.items(), key=lambda item: BLOCKS.index(item[1].block)))


def _list_effects(loaded: object) -> Iterator[EffectDescription]:
    if isinstance(loaded, EffectDescription):
        yield loaded
    elif isinstance(loaded, ModuleType) and hasattr(loaded, "__path__"):
        for info in pkgutil.walk_packages(loaded.__path__, f"{loaded.__name__}."):
            yield from _list_own(import_module(info.name))
    elif isinstance(loaded, ModuleType):
        if not (own := _list_own(loaded)):
            raise ValueError(f"the module {loaded.__name__} holds no EffectDescription")
        yield from own
    else:
        raise TypeError(f"{type(loaded).__name__} is not an EffectDescription")


def _list_own(module: ModuleType) -> list[EffectDescription]:
    """List the records that a module makes; one that it imports has its parameters elsewhere."""
    return [
        value
        for name, value in vars(module).items()
        if isinstance(value, EffectDescription)
        and (name == "DESCRIPTION" or value.kind.__module__ == module.__name__)
    ]


def check_effect(effect: EffectDescription) -> None:
    """Raise ValueError if a record contradicts itself or its places."""
    if not effect.name.isidentifier() or effect.block not in BLOCKS:
        raise ValueError(f"name {effect.name!r} or block {effect.block!r} is not valid")
    if not any(p.role == "size" for p in effect.parameters):
        raise ValueError("an effect needs a size, which switches it off at its neutral value")
    neutral = {p.name: p.neutral for p in effect.parameters}
    if effect.kind()._asdict() != neutral:
        raise ValueError(f"{effect.kind.__name__}() must hold the neutral values {neutral}")
    for entry in effect.entries:
        _check_entry(effect, entry)
    known = {p.name for p in effect.parameters}
    for form in effect.forms:
        if not {*form.free, *form.held} <= known:
            raise ValueError(f"form {form.name} names numbers that the effect does not have")


def _check_entry(effect: EffectDescription, entry: EffectEntry) -> None:
    if entry.place not in PLACES:
        raise ValueError(f"place {entry.place}: there are {', '.join(PLACES)}")
    place = PLACES[entry.place]
    gives = place.gives if entry.memory is None else ("memory", *place.gives)
    _check_arguments(entry.kernel, gives)
    if entry.memory is None:
        return
    if not place.follows:
        raise ValueError(f"place {entry.place}: an effect cannot remember there")
    if [PLACES[e.place].part for e in effect.entries if e.memory].count(place.part) > 1:
        raise ValueError(f"an effect has one memory in the {place.part}")
    _check_arguments(entry.memory.follow, place.follows)
    start = entry.memory.at_rest(0.0, nan)._asdict()
    if not all(isinstance(value, float) for value in start.values()):
        raise ValueError(f"a memory holds floats, not {start}")


def _check_arguments(kernel: Any, gives: tuple[str, ...]) -> None:
    if unknown := {*list_arguments(kernel)} - {*gives}:
        raise ValueError(
            f"{kernel.__name__}: no argument {min(unknown)}; its place gives {', '.join(gives)}"
        )


def list_arguments(kernel: Any) -> list[str]:
    """Return the names of a kernel's arguments after the first, the effect's parameters."""
    code = kernel.__code__
    return list(code.co_varnames[1 : code.co_argcount])


CATALOGUE: dict[str, EffectDescription] = load_effects()
"""Every effect by its name: first the pressure block, then the mechanics, then the sensors."""
WITH_TERMS: dict[str, EffectDescription] = {**CATALOGUE, **TERMS}
"""All whose numbers a plant may have: the effects, then the terms, one for each location."""


Kernel = Callable[..., Any]


def _make_group(name: str, defaults: Mapping[str, Any]) -> Any:
    return namedtuple(name, defaults, defaults=defaults.values(), module=__name__)


def _effects_of(part: Part) -> dict[str, Any]:
    return {name: effect.kind() for name, effect in CATALOGUE.items() if part in effect.parts}


TimingEffects = _make_group("TimingEffects", _effects_of("timing"))
ValveEffects = _make_group("ValveEffects", _effects_of("valve"))
AirEffects = _make_group("AirEffects", _effects_of("air"))
MechanicsEffects = _make_group("MechanicsEffects", _effects_of("mechanics"))
SensorEffects = _make_group("SensorEffects", _effects_of("sensors"))


class Effects(NamedTuple):
    """Parameters of every effect, by the part of a step that computes it; by default none acts.

    An effect that two parts compute appears in both. An effect that only changes the plant's own
    numbers appears in none.
    """

    timing: Any = TimingEffects()
    valve: Any = ValveEffects()
    air: Any = AirEffects()
    mechanics: Any = MechanicsEffects()
    sensors: Any = SensorEffects()


@cache
def order_entries(place: str) -> tuple[tuple[str, EffectEntry], ...]:
    """Return the effects of a place with their entries, in the order in which they act."""
    entries = {
        name: entry
        for name, effect in CATALOGUE.items()
        for entry in effect.entries
        if entry.place == place
    }
    before = {name: [n for n in entry.after if n in entries] for name, entry in entries.items()}
    return tuple((name, entries[name]) for name in TopologicalSorter(before).static_order())


def _make_memories(part: Part, position_m: float, pressure_pa: float) -> dict[str, Any]:
    return {
        name: entry.memory.at_rest(position_m, pressure_pa)
        for place, its in PLACES.items()
        if its.part == part
        for name, entry in order_entries(place)
        if entry.memory is not None
    }


ValveMemory = _make_group("ValveMemory", _make_memories("valve", 0.0, nan))
MechanicsMemory = _make_group("MechanicsMemory", _make_memories("mechanics", 0.0, nan))
SensorMemory = _make_group("SensorMemory", _make_memories("sensors", 0.0, nan))


@lru_cache(maxsize=256)
def make_rest_memories(position_m: float, pressure_pa: float) -> tuple[Any, Any, Any]:
    """Return the memories of valve, mechanics and sensors after a long rest."""
    groups: Any = {"valve": ValveMemory, "mechanics": MechanicsMemory, "sensors": SensorMemory}
    valve, mechanics, sensors = (
        group(**_make_memories(part, position_m, pressure_pa)) for part, group in groups.items()
    )
    return valve, mechanics, sensors


def change_numbers(numbers: Any, values: Mapping[str, float]) -> Any:
    """Return the plant's numbers (`PaperParameters`) with the effects of the place `numbers`.

    `values` holds the effects' parameters by their flat names.
    """
    for name, entry in order_entries("numbers"):
        parameters = CATALOGUE[name].parameters
        if any(values[f"{name}.{p.name}"] != p.neutral for p in parameters if p.role == "size"):
            effect = CATALOGUE[name].kind(*(values[f"{name}.{p.name}"] for p in parameters))
            numbers = entry.kernel(effect, numbers)
    return numbers


# --- composing ---------------------------------------------------------------------------------


def _compose(
    name: str, arguments: Iterable[str], body: Iterable[str], used: Mapping[str, Any]
) -> Kernel:
    """Make a kernel from lines of source; `used` holds the functions and types that they name."""
    source = "\n    ".join([f"def {name}({', '.join(arguments)}):", *body])
    scope: dict[str, Any] = {"__name__": __name__, **used}
    exec(compile(source, f"<{name}>", "exec"), scope)
    kernel: Kernel = scope[name]
    kernel.__dict__["source"] = source  # for those who translate it
    note_composed(source, used)
    return kernel


def _call(called: str, name: str, kernel: Kernel, **renamed: str) -> str:
    """Write the call of an effect's kernel with its arguments."""
    given = (renamed.get(argument, argument) for argument in list_arguments(kernel))
    return f"{called}({', '.join([f'effects.{name}', *given])})"


def _write_activity_test(name: str) -> str:
    """Write the test whether an effect is active."""
    sizes = [p for p in CATALOGUE[name].parameters if p.role == "size"]
    return " or ".join(f"effects.{name}.{p.name} != {p.neutral!r}" for p in sizes)


def _make_pass(place: str) -> Kernel:
    """Make (effects, memory, value, ...) -> value: all kernels of a place, one after the other.

    `memory` is an argument only if the place allows memories. `value` is the value that the place
    replaces, or the sum to which it adds.
    """
    its, used, body = PLACES[place], {}, []
    value = its.replaces or "total"
    for name, entry in order_entries(place):
        kernel = f"{name}_kernel"
        used[kernel] = entry.kernel
        call = _call(kernel, name, entry.kernel, memory=f"memory.{name}")
        acts = f"if {_write_activity_test(name)}: " if entry.memory is not None else ""
        body.append(f"{acts}{value} {'=' if its.replaces else '+='} {call}")
    memory = ["memory"] if its.follows else []
    others = [argument for argument in its.gives if argument != value]
    arguments = ["effects", *memory, value, *others]
    return _compose(f"pass_{place}", arguments, [*body, f"return {value}"], used)


def _make_follow(place: str, group: Any) -> Kernel:
    """Make (effects, memory, begin, end, step_s, ...) -> memory after a step.

    If the place passes a value, a memory follows the result of the kernels before it.
    """
    its, new, body = PLACES[place], {}, []
    used: dict[str, Any] = {"Memory": group}
    entries = order_entries(place)
    passes = "begin" in its.follows
    waiting = sum(entry.memory is not None for _, entry in entries)
    for name, entry in entries:
        if entry.memory is not None:
            follow, new[name] = f"{name}_follow", f"{name}_after"
            used[follow] = entry.memory.follow
            call = _call(follow, name, entry.memory.follow, memory=f"memory.{name}")
            body.append(f"{new[name]} = memory.{name}")
            body.append(f"if {_write_activity_test(name)}: {new[name]} = {call}")
            waiting -= 1
        if waiting and passes:
            kernel = f"{name}_kernel"
            used[kernel] = entry.kernel
            for value, memory in (("begin", f"memory.{name}"), ("end", f"{name}_after")):
                renamed = {"memory": memory, its.replaces: value}
                call = _call(kernel, name, entry.kernel, **renamed)
                body.append(f"if {_write_activity_test(name)}: {value} = {call}")
    fields = [new.get(name, f"memory.{name}") for name in group._fields]
    others = [a for a in its.gives if a != its.replaces] if passes else []
    arguments = ["effects", *its.follows, *others]
    return _compose(
        f"follow_{place}", arguments, [*body, f"return Memory({', '.join(fields)})"], used
    )


def _make_speed_test() -> Kernel:
    """Make (effects) -> bool: whether any active effect has a force that depends on speed."""
    tests = [
        _write_activity_test(name)
        for place in ("pulling_pressure", "force", "friction", "damping")
        for name, entry in order_entries(place)
        if "velocity_m_per_s" in list_arguments(entry.kernel)
    ]
    return _compose(
        "depends_on_speed", ["effects"], [f"return {' or '.join(tests) or 'False'}"], {}
    )


pass_command = _make_pass("command")
follow_command = _make_follow("command", ValveMemory)
pass_opening = _make_pass("opening")
follow_opening = _make_follow("opening", ValveMemory)
add_flow: Callable[..., float] = _make_pass("flow")
pass_volume: Callable[..., float] = _make_pass("volume")
pass_pulling_pressure = _make_pass("pulling_pressure")
add_force = _make_pass("force")
follow_force = _make_follow("force", MechanicsMemory)
pass_friction = _make_pass("friction")
follow_friction = _make_follow("friction", MechanicsMemory)
add_damping = _make_pass("damping")
follow_damping = _make_follow("damping", MechanicsMemory)
pass_pressure_reading = _make_pass("pressure_reading")
follow_pressure_reading = _make_follow("pressure_reading", SensorMemory)
pass_position_reading = _make_pass("position_reading")
follow_position_reading = _make_follow("position_reading", SensorMemory)
depends_on_speed = _make_speed_test()


def undo_reading(
    place: str,
    effects: Any,
    shown: Any,
    times_s: Any,
    atmosphere_pa: float,
    names: Collection[str] | None = None,
) -> Any:
    """Return the readings of an ideal sensor (arrays), as far as effects can be undone.

    `effects` are the `SensorEffects`; with `names` only those are undone.
    """
    for name, entry in reversed(order_entries(place)):
        effect = getattr(effects, name)
        is_chosen = names is None or name in names
        if entry.undo is not None and is_chosen and effect != CATALOGUE[name].kind():
            shown = entry.undo(effect, shown, times_s, atmosphere_pa)
    return shown


def undo_valve_v(effects: Any, names: Collection[str], wanted_v: float) -> float:
    """Return the command (V) at which the valve opens as an ideal one does at `wanted_v`.

    `effects` are the `ValveEffects`; those in `names` are undone.
    """
    for place in ("opening", "command"):
        for name, entry in reversed(order_entries(place)):
            if name in names and entry.undo is not None:
                wanted_v = float(entry.undo(getattr(effects, name), wanted_v))
    return wanted_v
