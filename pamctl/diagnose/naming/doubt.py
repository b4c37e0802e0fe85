"""A name is doubtful if the effect's size may be zero, or differs from one stretch to another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pamctl.diagnose.fitting.block_fit import Fit
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model, has_natural_end
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.search import EffectSearch

UNSURE = 0.6
"""Half an interval over the distance from neutral; at 1 the interval reaches neutral."""
SMALL_GAIN = 1.5
"""Residual over floor without the effect, divided by that with it."""
PIECES = 12
"""Pieces of the fitted records, at least; each record is a piece or several."""
WITHIN = 1.645
"""Half a 90 % interval in standard errors."""


def has_doubtful_effect(
    model: Model, search: EffectSearch, numbers: Sequence[FittedNumber]
) -> bool:
    """Tell whether an effect of a model is uncertain in size and explains little.

    Either alone may happen to a true effect: a small effect gains little, and the size of a delay
    within one tick is uncertain. In a set of several, an effect whose size differs from one piece
    of the records to another only helps the others to fit.
    """
    several = len(model.effects) > 1
    return any(
        (several and spread_of_effect(model, effect) > UNSURE)
        or (
            _is_unsure(effect.name, model, numbers)
            and _gain_of_effect(effect.name, model, search) < SMALL_GAIN
        )
        for effect in model.effects
    )


def _is_unsure(name: str, model: Model, numbers: Sequence[FittedNumber]) -> bool:
    own = [number for number in numbers if number.name.startswith(f"{name}.")]
    return bool(own) and all(
        0.5 * (n.high - n.low) > UNSURE * abs(n.value - value_of(model.evidence.nominal, n.name))
        for n in own
    )


def _gain_of_effect(name: str, model: Model, search: EffectSearch) -> float:
    """Return how much worse the worst block is without an effect; infinite if not tried."""
    others = {*model.names} - {name}
    tried = (search.base, *search.models)
    without = [_worst_ratio(m) for m in tried if {*m.names} == others]
    return min(without, default=float("inf")) / _worst_ratio(model)


def _worst_ratio(model: Model) -> float:
    return max(model.ratio(block) for block in model.evidence.blocks)


def spread_of_effect(model: Model, effect: Candidate) -> float:
    """Return by how much the pieces of the records disagree about an effect's surest size.

    It is half a 90 % interval over the distance from neutral. A wrong neighbour imitates what is
    missing in some stretches better than in others, and each asks for another size of it. A size
    that ended where nature ends it is not asked, but the numbers that shape the effect.
    """
    shares = [np.inf]
    for fitted in model.fits.values():
        ended = [s for s in effect.switches if s.name in fitted.at_bound and has_natural_end(s)]
        for size in effect.shapes if ended and effect.shapes else effect.switches:
            if size.name in fitted.values:
                away = abs(fitted.values[size.name] - value_of(model.evidence.nominal, size.name))
                shares.append(spread_of_size(fitted, size.name) / max(away, 1e-3 * size.scale))
    return min(shares)


def spread_of_size(fitted: Fit, name: str) -> float:
    """Return half the 90 % interval of a number, by leaving out one piece after the other.

    Each time the fit is corrected by one Gauss-Newton step (a jackknife).
    """
    place = next(i for i, free in enumerate(fitted.free) if free.name == name)
    slope, residual = fitted.jacobian, fitted.residual
    parts = [(slope[a:b].T @ slope[a:b], slope[a:b].T @ residual[a:b]) for a, b in _cut(fitted)]
    curvature, gradient = (sum(p[k] for p in parts) for k in (0, 1))
    steps: Array = np.array(
        [-np.linalg.lstsq(curvature - c, gradient - g, rcond=1e-10)[0][place] for c, g in parts]
    )
    count = len(steps)
    error = np.sqrt((count - 1) / count * np.sum((steps - steps.mean()) ** 2))
    return float(WITHIN * error * fitted.free[place].scale)


def _cut(fitted: Fit) -> Iterator[tuple[int, int]]:
    """Yield the first row and the end of each piece of the stacked residual."""
    longest = max(len(fitted.residual) // PIECES, 1)
    start = 0
    for drive in fitted.drives:
        count = max(round(drive.samples / longest), 1)
        edges = start + np.arange(count + 1) * drive.samples // count
        yield from zip(map(int, edges[:-1]), map(int, edges[1:]), strict=True)
        start += drive.samples
