"""Operon (pyoperon): symbolic regression of what the recalibrated blocks leave.

The expression is free; the effect is named whose columns explain at least half of it, and a set
where several do so equally well. A model that leaves the held-out rows as they are is no
discrepancy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from block_rows import Array, Block, make_blocks
from naming import HELD_OUT_GAIN, MEANT, fit_columns, make_verdict, name_model

GENERATIONS = 30
POPULATION = 500


def diagnose_task(task: Any) -> dict[str, Any]:
    """Return a verdict on a task of the benchmark."""
    return diagnose_by(task, regress)


def regress(inputs: Array, target: Array, held: Array) -> Any:
    """Return the values of the best expression on the training and on the held-out rows."""
    from pyoperon.sklearn import SymbolicRegressor

    model = SymbolicRegressor(
        allowed_symbols="add,sub,mul,div,exp,tanh,abs,square,sqrt,constant,variable",
        objectives=["r2", "length"],
        optimizer_iterations=5,
        max_length=20,
        population_size=POPULATION,
        generations=GENERATIONS,
        n_threads=1,
        random_state=1,
        model_selection_criterion="bayesian_information_criterion",
    )
    model.fit(inputs, target)
    return np.ravel(model.predict(inputs)), np.ravel(model.predict(held))


def diagnose_by(task: Any, method: Any) -> dict[str, Any]:
    """Let a method model what each recalibrated block leaves, and name what it found."""
    groups: list[list[str]] = []
    discrepancy = False
    sure = True
    for train, held in make_blocks(task.train, task.held_out, task.card).values():
        found, gain, explained = _model_block(train, held, method)
        if gain > HELD_OUT_GAIN:
            discrepancy = True
            groups += found
            sure = sure and explained > MEANT
    return make_verdict(groups, discrepancy=discrepancy, sure=sure)


def _model_block(train: Block, held: Block, method: Any) -> tuple[list[list[str]], float, float]:
    """Return the effects meant, the held-out share taken away, and the share that they explain."""
    plain = fit_columns(train.base, train.target, held.base, held.target)
    deviation = max(float(np.std(plain.left)), 1e-300)
    found, on_held = method(train.inputs, plain.left / deviation, held.inputs)
    after = plain.held_out / deviation - on_held
    before = plain.held_out / deviation
    usable = np.isfinite(after)
    gain = 1 - float(np.mean(after[usable] ** 2)) / float(np.mean(before[usable] ** 2))
    groups = name_model(train, np.nan_to_num(found))
    explained = 0.0
    if groups:
        wider = [np.column_stack([train.base, f]) for f in train.effects[groups[0][0]]]
        lefts = [fit_columns(c, found, c, found).left for c in wider]
        explained = 1 - min(float(e @ e) for e in lefts) / max(float(found @ found), 1e-300)
    return groups, gain, explained
