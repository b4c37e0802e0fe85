"""Load all effects, shipped and outside ones, from the entry point group `pamctl.effects`.

An entry point names a record (`my_package.my_effect:DESCRIPTION`), a module that holds one as
`DESCRIPTION`, or a package of such modules. The shipped effects are such a package. It is
always loaded, also where an old installation does not declare it.

An outside effect that cannot be loaded is left out with a warning: a broken package must not keep
the valve from its safe voltage. A plant file that names it is refused as for any unknown effect.
"""

from __future__ import annotations

import pkgutil
import warnings
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from math import nan
from types import ModuleType
from typing import Any

from pamctl.plant.effects.description import EffectDescription, EffectEntry
from pamctl.plant.effects.places import PLACES
from pamctl.plant.terms.locations import TERMS

GROUP = "pamctl.effects"
SHIPPED = EntryPoint("shipped", "pamctl.plant.effects", GROUP)
BLOCKS = ("pressure", "mechanics", "sensors")


def load_effects() -> dict[str, EffectDescription]:
    """Load the effects of all entry points, by name; the shipped ones first in each block."""
    found: dict[str, EffectDescription] = {}
    for point in [SHIPPED, *(p for p in entry_points(group=GROUP) if p.value != SHIPPED.value)]:
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
            effect = getattr(import_module(info.name), "DESCRIPTION", None)
            if isinstance(effect, EffectDescription):
                yield effect
    elif isinstance(loaded, ModuleType):
        yield loaded.DESCRIPTION
    else:
        raise TypeError(f"{type(loaded).__name__} is not an EffectDescription")


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
