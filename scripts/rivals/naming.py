"""From a regression to a verdict: which effects of the catalogue a model of the residual means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from block_rows import Array, Block

CLEAR = 10.0
"""A difference in BIC that counts as decisive (Kass and Raftery 1995)."""
HELD_OUT_GAIN = 0.03
"""Share of the held-out mean square that an effect must take away: less is no discrepancy. It is a
share of what the recalibrated start model leaves, so that no rung mends what a grid left."""
MEANT = 0.9
"""Share of a found model's variance that the columns of an effect must explain, to be meant."""
SOMETHING = 0.5
"""Below this share for every effect, the found model means nothing that has a name."""


@dataclass(frozen=True)
class Fit:
    """A least-squares fit, with what it leaves of the rows it was fitted on and of others."""

    weights: Array
    left: Array
    held_out: Array
    scores: float
    """BIC."""


def fit_columns(train: Array, target: Array, held: Array, held_target: Array) -> Fit:
    """Fit columns, scaled; `scores` is BIC with as many samples as there are rows."""
    scale = np.maximum(np.linalg.norm(train, axis=0), 1e-300)
    weights = np.linalg.lstsq(train / scale, target, rcond=None)[0] / scale
    left = target - train @ weights
    rows, numbers = train.shape
    bic = rows * np.log(max(float(np.mean(left**2)), 1e-300)) + numbers * np.log(rows)
    return Fit(weights, left, held_target - held @ weights, float(bic))


def is_better_held_out(start: Fit, before: Fit, after: Fit) -> bool:
    """Tell whether a fit leaves clearly less of the held-out rows than the one before it."""
    left = [float(np.mean(fit.held_out**2)) for fit in (start, before, after)]
    return left[1] - left[2] > HELD_OUT_GAIN * left[0]


def name_model(train: Block, found: Array) -> list[list[str]]:
    """Return the effects that a model's values on the training rows mean.

    One list of one name: that effect. One list of several: they explain it equally well. Empty: a
    model that no effect explains. What a recalibration takes away is projected out of both sides.
    """
    base = np.linalg.qr(train.base / np.maximum(np.linalg.norm(train.base, axis=0), 1e-300))[0]

    def clear(columns: Array) -> Array:
        return np.asarray(columns - base @ (base.T @ columns))

    meant = clear(found[:, None])[:, 0]
    power = float(meant @ meant)
    shares: dict[str, float] = {}
    for name, forms in train.effects.items():
        for form in forms:
            columns = clear(form)
            scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            left = meant - scaled @ np.linalg.lstsq(scaled, meant, rcond=None)[0]
            shares[name] = max(shares.get(name, 0.0), 1 - float(left @ left) / max(power, 1e-300))
    best = max(shares.values(), default=0.0)
    if best < SOMETHING:
        return []
    near = sorted(name for name, share in shares.items() if share > best - 0.03)
    return [near]


def make_verdict(
    groups: Sequence[Sequence[str]], *, discrepancy: bool, sure: bool
) -> dict[str, Any]:
    """Return a verdict: groups of one name are named, larger ones cannot be told apart."""
    if not discrepancy:
        return {"verdict": "miscalibrated"}
    if not groups:
        return {"verdict": "none_known"}
    names = [group[0] for group in groups if len(group) == 1]
    sets = [list(group) for group in groups if len(group) > 1]
    verdict = "ambiguous" if sets else "named" if sure else "partial"
    effects = [{"name": name} for name in dict.fromkeys(names)]
    return {"verdict": verdict, "effects": effects, "ambiguous": sets}
