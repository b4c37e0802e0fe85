"""A name is doubtful if the effect's size may be zero and the effect explains little."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.naming.search import EffectSearch

UNSURE = 0.6
"""Half an interval over the distance from neutral; at 1 the interval reaches neutral."""
SMALL_GAIN = 1.5
"""Residual over floor without the effect, divided by that with it."""


def has_doubtful_effect(
    model: Model, search: EffectSearch, numbers: Sequence[FittedNumber]
) -> bool:
    """Tell whether an effect of a model is uncertain in size and explains little.

    Either alone may happen to a true effect: a small effect gains little, and the size of a delay
    within one tick is uncertain.
    """
    return any(
        _is_unsure(name, model, numbers) and _gain_of_effect(name, model, search) < SMALL_GAIN
        for name in model.names
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
