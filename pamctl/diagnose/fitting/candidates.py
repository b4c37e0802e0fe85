"""The effects that may be missing, and small doses of each.

Some numbers of an effect switch it on (a width, a stiffness). Others only shape it (a time
constant, a damping ratio). An effect with several forms (elasto-plastic or Dahl, a static supply
or a tank) is a candidate in each form, under one name.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.numbers import (
    FreeNumber,
    active_effects,
    look_up_parameter,
    numbers_of_effect,
    value_of,
)
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.description import EffectDescription, EffectForm
from pamctl.plant.model import PlantSettings

DOSES = (1.0, 6.0)
"""In units of the smallest size of interest. Two doses, because large and small effects differ."""


@dataclass(frozen=True)
class Candidate:
    """An effect of the catalogue in one of its forms, for the search."""

    name: str
    form: str
    free: tuple[FreeNumber, ...]
    held: tuple[tuple[str, float], ...]
    """Numbers that the form fixes, by full name."""
    blocks: frozenset[str]
    """The blocks that it affects."""

    @property
    def fixed_numbers(self) -> tuple[tuple[str, float], ...]:
        """The numbers that the form fixes and no fit may move."""
        moved = {f.name for f in self.free}
        return tuple((name, value) for name, value in self.held if name not in moved)

    @property
    def switches(self) -> tuple[FreeNumber, ...]:
        """The numbers that switch it on."""
        return tuple(f for f in self.free if look_up_parameter(f).role == "size")

    @property
    def shapes(self) -> tuple[FreeNumber, ...]:
        """The numbers that only shape it."""
        return tuple(f for f in self.free if look_up_parameter(f).role == "shape")


def list_candidates(evidence: Evidence, without: Collection[str] = ()) -> tuple[Candidate, ...]:
    """Return the effects that affect a block of the evidence, except those in `without`.

    Effects of the start model, and effects that no experiment can identify, are left out.
    """
    on = active_effects(evidence.nominal)
    return tuple(
        candidate
        for name, effect in CATALOGUE.items()
        if name not in {*without, *on} and effect.is_searched and not effect.unidentifiable
        for candidate in _list_forms(effect, evidence.blocks)
    )


def _list_forms(effect: EffectDescription, blocks: Collection[str]) -> Iterator[Candidate]:
    reached = frozenset(block for block in effect.seen_by if block in blocks)
    if not reached:
        return
    everything = tuple(p.name for p in effect.parameters if not p.choices)
    for form in effect.forms or (EffectForm(effect.name, everything),):
        held = tuple((f"{effect.name}.{n}", float(v)) for n, v in form.held.items())
        yield Candidate(
            effect.name, form.name, numbers_of_effect(effect.name, form.free), held, reached
        )


def apply_dose(number: FreeNumber, doses: float, neutral: float) -> float:
    """Return the value `doses` smallest sizes of interest away from neutral, within the range."""
    step = doses * number.scale
    if neutral + step <= number.high:
        return neutral + step
    return max(neutral - step, number.low) if neutral >= number.high else number.high


def generate_doses(
    candidate: Candidate, settings: PlantSettings
) -> Iterator[list[dict[str, float]]]:
    """Yield sets of small doses; a set holds one dose of every switch, for one shape."""
    for shape, doses in product(_vary_shapes(candidate, settings), DOSES):
        yield [
            {
                **shape,
                **dict(candidate.held),
                s.name: apply_dose(s, doses, value_of(settings, s.name)),
            }
            for s in candidate.switches
        ]


def _vary_shapes(candidate: Candidate, settings: PlantSettings) -> Iterator[dict[str, float]]:
    usual = {f.name: _usual_shape(f, settings) for f in candidate.shapes}
    yield usual
    for number in candidate.shapes:
        for end in (number.low, number.high):
            between = _geometric_mean(usual[number.name], end, number.high)
            if between != usual[number.name]:
                yield {**usual, number.name: between}


def _usual_shape(number: FreeNumber, settings: PlantSettings) -> float:
    """Return the catalogue's start value of a shape, or else the plant's value."""
    start = look_up_parameter(number).start
    return start if number.low < start < number.high else value_of(settings, number.name)


def _geometric_mean(value: float, end: float, high: float) -> float:
    """Return a geometric mean: shapes are times and speeds. A zero counts as `high` / 100."""
    least = 1e-2 * high
    return float(np.sqrt(max(value, least) * max(end, least))) if high > 0.0 else value


def select_reaching(found: Sequence[Candidate], blocks: Collection[str]) -> tuple[Candidate, ...]:
    """Return the candidates that affect one of the blocks."""
    return tuple(c for c in found if c.blocks & set(blocks))
