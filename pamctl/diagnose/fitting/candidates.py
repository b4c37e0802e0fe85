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

from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.numbers import (
    FreeNumber,
    active_effects,
    look_up_parameter,
    numbers_of_effect,
    value_of,
    with_values,
)
from pamctl.diagnose.measured.record import Array
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.description import EffectDescription, EffectForm
from pamctl.plant.model import PlantSettings

INERT = 1e-9
"""A dose that moves every output by less, as a share of what it spans, moves nothing."""
BEGINNING, FEWEST = 16, 1000
"""Share of a record, and samples, in which an effect shows that it moves something."""
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
        return tuple(f for f in self.free if look_up_parameter(f.name).role == "size")

    @property
    def shapes(self) -> tuple[FreeNumber, ...]:
        """The numbers that only shape it."""
        return tuple(f for f in self.free if look_up_parameter(f.name).role == "shape")


def list_candidates(evidence: Evidence, without: Collection[str] = ()) -> tuple[Candidate, ...]:
    """Return the effects that move a block of the evidence, except those in `without`.

    Effects of the start model, effects that no experiment can identify, and those of another
    actuator are left out; so are effects that change nothing here, such as friction that grows
    with a pressure that nobody measured.
    """
    nominal = evidence.nominal
    on = active_effects(nominal)
    found = [
        candidate
        for name, effect in CATALOGUE.items()
        if name not in {*without, *on}
        and effect.is_searched
        and not effect.unidentifiable
        and nominal.actuator in effect.actuators
        for candidate in list_forms(effect, evidence)
    ]
    return tuple(_leave_out_inert(found, evidence))


def _leave_out_inert(found: Sequence[Candidate], evidence: Evidence) -> Iterator[Candidate]:
    """Yield the candidates of which a dose moves an output by more than rounding.

    Some act on another effect only (dry friction that falls with speed needs dry friction): each
    is tried alone, then in the company of all others. An effect that moves one drive in one form
    stays in every form.
    """
    nominal = evidence.nominal
    whole = [d for block in evidence.blocks for d in evidence.train[block]]
    # Most effects show at once; the others are sought in the whole record.
    begins = [d.cut_beginning(max(len(d.measured) // BEGINNING, FEWEST)) for d in whole]
    doses = {c.name: dict(c.held) | _largest_dose(c, nominal) for c in reversed(found)}
    crowd: dict[str, float] = {}
    for dose in doses.values():
        crowd |= dose
    moving: dict[str, bool] = {}
    unmoved: dict[tuple[str, int], Array] = {}

    def moves(name: str, drive: Drive, company: dict[str, float], key: str) -> bool:
        known = (key, id(drive))
        if known not in unmoved:
            unmoved[known] = drive.simulate(with_values(nominal, company))
        moved = drive.simulate(with_values(nominal, company | doses[name]))
        change = np.nan_to_num(np.abs(moved - unmoved[known]), nan=np.inf)
        return bool(np.max(change) > INERT * np.ptp(drive.measured))

    for candidate in found:
        name = candidate.name
        if name not in moving:
            others = {n: v for n, v in crowd.items() if n not in doses[name]}
            moving[name] = not whole or any(
                moves(name, drive, company, key)
                for company, key in (({}, "alone"), (others, name))
                for drive in (*begins, *whole)
                if drive.block in candidate.blocks
            )
        if moving[name]:
            yield candidate


def _largest_dose(candidate: Candidate, nominal: PlantSettings) -> dict[str, float]:
    """Return the numbers of a visible dose of an effect."""
    shapes = {f.name: _usual_shape(f, nominal) for f in candidate.shapes}
    return shapes | {
        s.name: apply_dose(s, DOSES[-1], value_of(nominal, s.name)) for s in candidate.switches
    }


def list_forms(effect: EffectDescription, evidence: Evidence) -> Iterator[Candidate]:
    """Yield the forms of an effect; none where it moves no block of the evidence."""
    reached = frozenset(block for block in effect.seen_by if block in evidence.blocks)
    if not reached:
        return
    everything = tuple(p.name for p in effect.parameters if not p.choices)
    for form in effect.forms or (EffectForm(effect.name, everything),):
        held = tuple((f"{effect.name}.{n}", float(v)) for n, v in form.held.items())
        free = numbers_of_effect(effect.name, form.free, evidence.nominal, evidence.reach)
        yield Candidate(effect.name, form.name, free, held, reached)


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
    """Return the usual value of a shape, or else the plant's value."""
    start = look_up_parameter(number.name).start if number.usual is None else number.usual
    return start if number.low < start < number.high else value_of(settings, number.name)


def _geometric_mean(value: float, end: float, high: float) -> float:
    """Return a geometric mean: shapes are times and speeds. A zero counts as `high` / 100."""
    least = 1e-2 * high
    return float(np.sqrt(max(value, least) * max(end, least))) if high > 0.0 else value


def select_reaching(found: Sequence[Candidate], blocks: Collection[str]) -> tuple[Candidate, ...]:
    """Return the candidates that affect one of the blocks."""
    return tuple(c for c in found if c.blocks & set(blocks))
