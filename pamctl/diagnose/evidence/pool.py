"""The pool: all that may be missing from a model, as one type: a place, a law, free numbers.

Effects come from their own descriptions (`pamctl.plant.effects`), free terms from the locations of
`pamctl.plant.terms`, and what lies between the plant and the file from the table below. The kind
only chooses words; no hypothesis has a path of its own through the search.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from pamctl.plant.catalogue import CATALOGUE, list_arguments
from pamctl.plant.effects.description import (
    Actuator,
    EffectDescription,
    EffectForm,
    EffectParameter,
)
from pamctl.plant.terms import DRIVERS, KNOTS, LOCATIONS, OPERATORS, REFERENCES, Location

CHAIN = "~"
"""Begins the name of a number that no plant has: one of the chain between the plant and a file."""
WIDER = 10.0
"""A mechanism's ranges go so much further than a muscle's of the same force."""
SPREAD = 5.0
"""A shape with a unit is tried at its usual value, and at this factor to either side."""
END = 1e-3
"""Scales from an end of its range at which a number stands at it."""


@dataclass(frozen=True)
class Unknown:
    """A number that a fit moves."""

    name: str
    value: float
    """Where a fit begins."""
    low: float
    high: float
    scale: float
    """A step of this size is visible."""
    neutral: float | None = None
    """Of a size: where it does nothing. None: a shape, or a number of the plant."""
    smallest: float = 0.0
    """The smallest size of interest."""

    def ends_at(self, value: float) -> bool:
        """Tell whether a value stands at an end of the range that is not the neutral one."""
        inside = self.low + END * self.scale < value < self.high - END * self.scale
        return value != self.neutral and not inside


class Variant(NamedTuple):
    """One start of a hypothesis: what it holds, and what it frees."""

    held: Mapping[str, float]
    sizes: tuple[Unknown, ...]
    shapes: tuple[Unknown, ...] = ()

    @property
    def free(self) -> tuple[Unknown, ...]:
        """The sizes, then the shapes."""
        return (*self.sizes, *self.shapes)

    @property
    def form(self) -> tuple[object, ...]:
        """What it has in common with the variants that differ in their starts only."""
        return (tuple(sorted(self.held.items())), tuple(u.name for u in self.free))

    @property
    def is_curve(self) -> bool:
        """Tell whether the sizes are the knots of a curve."""
        return len(self.sizes) == KNOTS


@dataclass(frozen=True)
class Hypothesis:
    """Something that may be missing from a model."""

    name: str
    place: str
    kind: str
    variants: tuple[Variant, ...]
    family: str
    """Of one family only one is in a model: they share their numbers."""
    part: str = ""
    """A part of a step that holds one term only."""
    is_term: bool = False
    """A law without a name."""
    akin: tuple[str, ...] = ()
    """Free terms that the effect is, or is akin to: they can always mimic it."""
    setup: tuple[str, str] | None = None
    """Of a fault of the set-up: what is wrong, as documents call it, and the number or column."""
    scan: str = ""
    """Of a wave: the driver over which it repeats; its period is looked for first."""
    far: Variant | None = None
    """Where its fit begins from the plant file's numbers, as no tangent leads there: at an end of
    the stroke."""

    @property
    def laws(self) -> frozenset[tuple[str, str]]:
        """The location and the driver of the terms without a memory that it is, or is akin to."""
        terms = (self.name,) if self.is_term else self.akin
        split = (term.rstrip(")").replace("(", "~").split("~") for term in terms)
        return frozenset((at, by) for at, operator, by in split if by and operator not in _KINDS)

    @property
    def is_effect(self) -> bool:
        """Tell whether it is an effect of the catalogue that needs no search for a period."""
        return not (self.is_term or self.setup or self.scan)

    def may_be(self, term: Hypothesis) -> bool:
        """Tell whether this is a name of what a free term describes."""
        return not self.is_term and (self.place == term.place or term.name in self.akin)


class Scales(NamedTuple):
    """What a machine reaches: sizes of its force, travel, speed, gauge pressure and valve."""

    force_n: float = 476.0
    travel_m: float = 0.067
    speed_m_per_s: float = 0.067
    pressure_pa: float = 340e3
    valve_m2_per_v: float = 1.03e-6

    def size_of(self, unit: str) -> float:
        """Return the usual size of a quantity; 1 for a ratio or a time."""
        force, way, speed, gauge = self.force_n, self.travel_m, self.speed_m_per_s, self.pressure_pa
        return {
            "N": force,
            "m": way,
            "m/s": speed,
            "kg": force * way / speed**2,
            "N/m": force / way,
            "N/m3": force / way**3,
            "m/N": way / force,
            "N s/m": force / speed,
            "N/Pa": force / gauge,
            "N s/(m Pa)": force / (speed * gauge),
        }.get(unit, 1.0)


PAPER_SCALES = Scales()

# --- effects -------------------------------------------------------------------------------------


def list_effects(
    actuator: Actuator, machine: Scales, *, fitted: bool = True
) -> Iterator[Hypothesis]:
    """Yield the effects of the catalogue that may act on this actuator; a drift for each number.

    With `fitted` False, yield those that no records identify instead.
    """
    for name, effect in CATALOGUE.items():
        if (effect.unidentifiable is None) != fitted or actuator not in effect.actuators:
            continue
        if "phase_rad" in {p.name for p in effect.parameters}:
            yield _make_ripple(effect)
            continue
        sizes = [p.name for p in effect.parameters if p.role == "size"]
        forms = effect.forms or (EffectForm("", tuple(p.name for p in effect.parameters)),)
        groups = {name: forms}
        if all(len(form.free) == 1 for form in forms) and len(forms) == len(sizes) > 2:
            groups = {f"{name}:{form.free[0]}": (form,) for form in forms}
        for number, (called, its) in enumerate(groups.items()):
            variants = tuple(v for form in its for v in _make_variants(effect, form, machine))
            place = _find_place(effect, number if len(groups) > 1 else None)
            yield Hypothesis(
                called, place, _find_kind(effect), variants, name, akin=_list_akin(effect)
            )


def list_absent(actuator: Actuator, stiffness_n_per_m: float) -> tuple[str, ...]:
    """Return the effects of what a plant file says is not there: no spring, no creep of it.

    A muscle's own rubber creeps whatever its spring.
    """
    return ("creep",) if actuator in ("direct", "cylinder") and stiffness_n_per_m == 0.0 else ()


def _make_variants(
    effect: EffectDescription, form: EffectForm, machine: Scales
) -> Iterator[Variant]:
    """Yield the starts of a form: a shape that has a unit is tried at three values."""
    held: dict[str, float] = {}
    sizes, shapes, spread = [], [], []
    for p in effect.parameters:
        dotted, start = f"{effect.name}.{p.name}", form.held.get(p.name, p.start)
        if p.role == "size":
            if p.name in form.free:
                sizes.append(_make_unknown(dotted, p, start, machine))
        elif p.name in form.free and start > 0.0 and not p.choices:
            shape = _make_unknown(dotted, p, start, machine)
            shapes.append(shape)
            if p.unit not in ("", "1"):
                spread.append(shape)
        else:
            held[dotted] = start
    for factor in (1.0, 1.0 / SPREAD, SPREAD) if spread else (1.0,):
        moved = {s.name: replace(s, value=_clip(factor * s.value, s)) for s in spread}
        yield Variant(held, tuple(sizes), tuple(moved.get(s.name, s) for s in shapes))


def _clip(value: float, unknown: Unknown) -> float:
    return min(max(value, 1.5 * unknown.low), 0.7 * unknown.high)


def _make_unknown(name: str, p: EffectParameter, start: float, machine: Scales) -> Unknown:
    ratio = machine.size_of(p.unit) / PAPER_SCALES.size_of(p.unit) if p.is_scaled else 1.0
    wider = WIDER if p.is_scaled and machine != PAPER_SCALES else 1.0
    low, high = p.low * ratio * wider, p.high * ratio * wider
    if p.role == "shape":
        value = start * ratio
        return Unknown(name, value, max(p.low * ratio, value / 30.0), high, 0.3 * value)
    small = p.smallest_of_interest * ratio
    away = (start - p.neutral) * ratio if p.neutral == 0.0 else start - p.neutral
    return Unknown(name, p.neutral + away, low, high, max(abs(away), small), p.neutral, abs(small))


def _find_place(effect: EffectDescription, number: int | None) -> str:
    """Return where an effect acts: the place of its term, or else the file of its kernels."""
    places = [place_of(term.location) for term in effect.as_terms]
    if number is not None:  # a drift of several numbers: as its terms, without the valve's others
        firsts = list(dict.fromkeys(places))
        return firsts[min(number, len(firsts) - 1)]
    if "supply" in places:
        return "supply"
    if effect.block == "sensors":
        return place_of(
            "encoder" if any(e.place == "position_reading" for e in effect.entries) else
            "pressure_sensor"
        )  # fmt: skip
    file = effect.kind.__module__.removeprefix("pamctl.plant.effects.")
    if file in ("valve", "air", "friction"):
        return file
    if any(e.place == "friction" for e in effect.entries):
        return "friction"
    outside = [part for part in ("valve", "air") if part in effect.parts and file != "mechanics"]
    return outside[0] if outside else "pull"


def place_of(location: str) -> str:
    """Return the place of a term's location: one word for what a user can look at."""
    its = LOCATIONS[location]
    if location == "supply" or its.part == "valve":
        return "supply" if location == "supply" else "valve"
    if its.part == "sensors":
        return location
    if its.part == "air":
        return "air"
    return "friction" if "friction" in location or location == "damping" else "pull"


_KINDS = {"lag": "lag", "slew": "lag", "play": "memory", "hysteresis": "memory"}


def _find_kind(effect: EffectDescription) -> str:
    """Return what kind of law an effect is: that of the term which it is, or of its memory."""
    for term in effect.as_terms:
        if term.operator in _KINDS:
            return _KINDS[term.operator]
        if term.driver:
            return f"over {term.driver}"
    for entry in effect.entries:
        if entry.memory is not None:
            return "lag" if "step_s" in list_arguments(entry.memory.follow) else "memory"
    return "constant" if effect.as_terms else effect.name


def _list_akin(effect: EffectDescription) -> tuple[str, ...]:
    return tuple(f"{t.location}~{t.operator}({t.driver})" for t in effect.as_terms)


def _make_ripple(effect: EffectDescription) -> Hypothesis:
    """Return a wave in time: two sizes instead of amplitude and phase, and a period to look for."""
    size, rate, _ = effect.parameters
    return _make_wave(
        effect.name, "supply", effect.name, "", "time", size.start,
        size.smallest_of_interest, f"{effect.name}.{rate.name}", False, {},
    )  # fmt: skip


def _make_wave(
    name: str, place: str, family: str, part: str, driver: str, usual: float, smallest: float,
    inner: str, is_term: bool, held: Mapping[str, float],
) -> Hypothesis:  # fmt: skip
    pair = tuple(
        Unknown(f"{CHAIN}{family}.{half}", usual, -200 * usual, 200 * usual, usual, 0.0, smallest)
        for half in ("sine", "cosine")
    )
    period = Unknown(inner, 1.0, 0.0, 1.0, 1.0)
    return Hypothesis(
        name, place, "wave", (Variant(held, pair, (period,)),), family, part, is_term, scan=driver
    )


# --- free terms ----------------------------------------------------------------------------------

CURVES: Mapping[str, tuple[str, ...]] = {
    "command": ("time",),
    "filling": ("command", "time"),
    "exhausting": ("command", "time"),
    "opening": ("time",),
    "supply": ("time",),
    "flow": ("pressure", "position", "time"),
    "volume": ("position", "pressure"),
    "force": ("position", "pressure", "time"),
    "stiffness": ("time",),
    "damping": ("velocity", "position", "pressure"),
    "braid_friction": ("position", "velocity", "pressure", "time"),
    "dry_friction": ("position", "velocity", "time"),
    "pull": ("position", "time"),
    "pressure_sensor": ("pressure", "time"),
    "encoder": ("position", "time"),
}
"""Curves that differ from each other; all others are nearly one of these."""
WAVES = ("force", "encoder")
"""Locations where something may repeat over the position: magnets, teeth, a disc off its centre."""
OTHERS: Sequence[tuple[str, str, str, tuple[float, ...]]] = (
    ("force", "hysteresis", "position", (5e-3, 3e-2)),
    ("force", "lag", "position", (0.3, 3.0)),
    ("command", "lag", "command", (0.002, 0.02)),
    ("force", "beyond", "position", (0.5,)),
    ("command", "onset", "time", (0.25, 0.5, 0.75)),
    ("leak", "onset", "time", (0.15, 0.3, 0.45, 0.6, 0.75, 0.9)),
    ("force", "onset", "time", (0.25, 0.5, 0.75)),
    ("stiffness", "onset", "time", (0.25, 0.5, 0.75)),
    ("opening", "onset", "time", (0.25, 0.5, 0.75)),
    ("braid_friction", "onset", "time", (0.25, 0.5, 0.75)),
)
"""Location, operator, driver, and inner numbers: of lags in s, of others shares of the reach."""


def list_terms(
    actuator: Actuator, reach: Mapping[str, tuple[float, float]], machine: Scales
) -> Iterator[Hypothesis]:
    """Yield laws without a name, at every place of this actuator whose driver was measured.

    `reach` holds the range of each driver in the records, and no driver that they do not show.
    """
    for name, drivers in CURVES.items():
        location = LOCATIONS[name]
        for driver in drivers:
            if actuator in location.actuators and driver in reach:
                yield _make_curve(location, driver, reach[driver], machine)
    for name, operator, driver, inner in OTHERS:
        location = LOCATIONS[name]
        if actuator in location.actuators and driver in reach:
            yield _make_operator(location, operator, driver, inner, reach[driver], machine)
    for name in WAVES if "position" in reach else ():
        location = LOCATIONS[name]
        if actuator in location.actuators:
            usual = _usual_size(location, machine)
            yield _make_wave(
                f"{name}~wave(position)", place_of(name), location.term_name, location.part,
                "position", usual, usual, f"{location.term_name}.inner", True,
                _hold(location, "wave", "position"),
            )  # fmt: skip


def _usual_size(location: Location, machine: Scales) -> float:
    return location.usual * machine.size_of(location.unit) / PAPER_SCALES.size_of(location.unit)


def _hold(location: Location, operator: str, driver: str) -> dict[str, float]:
    return {
        f"{location.term_name}.operator": float(OPERATORS.index(operator)),
        f"{location.term_name}.driver": float(DRIVERS.index(driver)),
    }


def _make_curve(
    location: Location, driver: str, span: tuple[float, float], machine: Scales
) -> Hypothesis:
    term, usual = location.term_name, _usual_size(location, machine)
    held = {
        **_hold(location, "curve", driver),
        f"{term}.size": usual,
        f"{term}.low": span[0],
        f"{term}.high": span[1],
    }
    knots = tuple(
        Unknown(f"{term}.knot_{k}", 1.0, -1e3, 1e3, 1.0, 0.0, 1.0) for k in range(1, KNOTS + 1)
    )
    return Hypothesis(
        f"{location.name}~curve({driver})", place_of(location.name), f"over {driver}",
        (Variant(held, knots),), term, location.part, True,
    )  # fmt: skip


def _make_operator(
    location: Location, operator: str, driver: str, inners: Sequence[float],
    span: tuple[float, float], machine: Scales,
) -> Hypothesis:  # fmt: skip
    term, wide = location.term_name, span[1] - span[0]
    usual = _usual_size(location, machine)
    if operator in ("lag", "beyond"):  # for each reference of the driver, not for all its way
        usual *= REFERENCES[driver] / wide * 10.0
    size = Unknown(f"{term}.size", usual, -1e3 * usual, 1e3 * usual, usual, 0.0, usual)
    variants = []
    for share in inners:
        inner = share if operator == "lag" else span[0] + share * wide
        inner = share * wide if operator == "hysteresis" else inner
        shape = Unknown(f"{term}.inner", inner, inner / 20.0, inner * 20.0, 0.2 * abs(inner))
        held = _hold(location, operator, driver)
        variants.append(Variant(held, (size,), (shape,)))
    kind = _KINDS.get(operator, operator if operator == "onset" else f"over {driver}")
    return Hypothesis(
        f"{location.name}~{operator}({driver})", place_of(location.name), kind, tuple(variants),
        term, location.part, True,
    )  # fmt: skip
