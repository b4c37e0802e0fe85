"""Two more effects at once, where each alone explains little.

One effect may hide behind another: the heat of the walls and a nozzle that chokes early both slow
the end of a filling, and each without the other makes the rest worse. One dose of every candidate
is simulated. To first order, every pair is then a least-squares problem of a few columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, islice

import numpy as np

from pamctl.diagnose.fitting.block_fit import Fit, find_secants, project_out
from pamctl.diagnose.fitting.candidates import DOSES, Candidate, generate_doses, select_reaching
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import fit_model
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.score import (
    choose_start,
    dose_range,
    find_movable_basis,
    fit_amounts,
    score_candidates,
)
from pamctl.plant.model import PlantSettings

MOST_PAIRS = 3
"""Pairs of names that are fitted."""
MUCH_BETTER = 0.5
"""A pair must leave at most this share of the square that the best of the single effects leaves."""


@dataclass(frozen=True)
class PairScore:
    """How much two candidates together promise to explain of what a model leaves."""

    pair: tuple[Candidate, Candidate]
    left: float
    """Share of the residual's square that they leave."""
    start: dict[str, float]


def fit_pairs(model: Model, candidates: Sequence[Candidate], block: str) -> list[Model]:
    """Fit a model with the most promising pairs, if any promises much more than its parts."""
    scores = score_pairs(model, candidates, block)
    best: dict[frozenset[str], PairScore] = {}
    for score in scores:
        best.setdefault(frozenset(c.name for c in score.pair), score)
    return [
        fit_model(model, (*model.effects, *score.pair), [score.start])
        for score in [*best.values()][:MOST_PAIRS]
    ]


def score_pairs(model: Model, candidates: Sequence[Candidate], block: str) -> list[PairScore]:
    """Return the pairs that promise much more than any single candidate, the best first."""
    fitted = model.fit_of(block)
    others = [c for c in select_reaching(candidates, {block}) if c.name not in model.names]
    doses = {c: _choose_doses(c, fitted.settings) for c in others}
    secants = find_secants(fitted, [dose for c in others for dose in doses[c]])
    columns = np.column_stack([secants, fitted.residual])
    # The triangle's few rows stand for all samples.
    triangle: Array = np.asarray(
        np.linalg.qr(project_out(find_movable_basis(fitted), columns), mode="r")
    )
    ends = np.cumsum([len(doses[c]) for c in others])
    parts = {c: triangle[:, end - len(doses[c]) : end] for c, end in zip(others, ends, strict=True)}
    alone = max((s.explained for s in score_candidates(fitted, others, block)), default=0.0)
    found = (
        _score_pair(pair, [parts[c] for c in pair], [doses[c] for c in pair], triangle, fitted)
        for pair in combinations(others, 2)
        if pair[0].name != pair[1].name
    )
    promising = (score for score in found if score.left <= MUCH_BETTER * (1.0 - alone))
    return sorted(promising, key=lambda score: score.left)


def _score_pair(
    pair: tuple[Candidate, Candidate],
    parts: Sequence[Array],
    doses: Sequence[Sequence[dict[str, float]]],
    triangle: Array,
    fitted: Fit,
) -> PairScore:
    left, secants = triangle[:, -1], np.column_stack(parts)
    ranges = [dose_range(c, fitted.settings, d) for c, d in zip(pair, doses, strict=True)]
    low, high = (np.concatenate(ends) for ends in zip(*ranges, strict=True))
    amounts = fit_amounts(secants, left, (low, high))
    rest = float(np.sum((left - secants @ amounts) ** 2) / np.sum(left**2))
    split = np.split(amounts, [parts[0].shape[1]])
    starts = [
        choose_start(c, fitted.settings, d, a) for c, d, a in zip(pair, doses, split, strict=True)
    ]
    return PairScore(pair, rest, starts[0] | starts[1])


def _choose_doses(candidate: Candidate, settings: PlantSettings) -> list[dict[str, float]]:
    """Return the largest dose of every switch, for the usual shape."""
    return [*islice(generate_doses(candidate, settings), len(DOSES))][-1]
