"""A ladder of least-squares models chosen by BIC, as one would do it by hand.

Rung by rung the effect of the catalogue is added that lowers BIC most; the ladder ends where BIC or
the held-out rows no longer gain. Effects within ten of the best BIC are said to be inseparable.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from block_rows import Array, Block, make_blocks
from naming import CLEAR, Fit, fit_columns, is_better_held_out, make_verdict

MOST_RUNGS = 3


def diagnose_task(task: Any) -> dict[str, Any]:
    """Return a verdict on a task of the benchmark."""
    blocks = make_blocks(task.train, task.held_out, task.card)
    groups = [group for train, held in blocks.values() for group in climb(train, held)]
    return make_verdict(groups, discrepancy=bool(groups), sure=True)


def climb(train: Block, held: Block) -> list[list[str]]:
    """Return the effects of a block, rung by rung; a rung is one name or an inseparable set."""
    columns, held_columns = train.base, held.base
    start = best = fit_columns(columns, train.target, held_columns, held.target)
    rungs: list[list[str]] = []
    for _ in range(MOST_RUNGS):
        tried: list[tuple[float, str, Array, Array, Fit]] = []
        for name, forms in train.effects.items():
            if any(name in rung for rung in rungs):
                continue
            for form, held_form in zip(forms, held.effects[name], strict=True):
                wider = np.column_stack([columns, form])
                held_wider = np.column_stack([held_columns, held_form])
                fit = fit_columns(wider, train.target, held_wider, held.target)
                tried.append((fit.scores, name, wider, held_wider, fit))
        if not tried:
            break
        score, _, wider, held_wider, fit = min(tried, key=lambda one: one[0])
        if score > best.scores - CLEAR or not is_better_held_out(start, best, fit):
            break
        rungs.append(sorted({name for each, name, *_ in tried if each < score + CLEAR}))
        columns, held_columns, best = wider, held_wider, fit
    return rungs
