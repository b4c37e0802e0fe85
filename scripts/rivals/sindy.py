"""PySINDy's sparse regression (STLSQ) over the library of the catalogue's columns.

The threshold comes from a grid, by BIC on the training rows, as PySINDy's users do; columns are
normalised, the base is projected out before. Names are those of the columns that survive.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from block_rows import Block, make_blocks
from naming import fit_columns, is_better_held_out, make_verdict

THRESHOLDS = np.geomspace(0.01, 1.0, 13)
"""In standard deviations of the target: the columns have norm 1."""


def diagnose_task(task: Any) -> dict[str, Any]:
    """Return a verdict on a task of the benchmark."""
    blocks = make_blocks(task.train, task.held_out, task.card)
    names = [name for train, held in blocks.values() for name in select_names(train, held)]
    return make_verdict([[name] for name in names], discrepancy=bool(names), sure=True)


def select_names(train: Block, held: Block) -> list[str]:
    """Return the effects whose columns survive, or nothing where the held-out rows do not gain."""
    from pysindy import STLSQ

    labels = [n for n, forms in train.effects.items() for f in forms for _ in range(f.shape[1])]
    library = np.column_stack([f for forms in train.effects.values() for f in forms])
    held_library = np.column_stack([f for n in train.effects for f in held.effects[n]])
    basis = np.linalg.qr(train.base / np.maximum(np.linalg.norm(train.base, axis=0), 1e-300))[0]
    free = library - basis @ (basis.T @ library)
    target = train.target - basis @ (basis.T @ train.target)
    norms = np.linalg.norm(free, axis=0)
    usable = norms > 1e-6 * np.linalg.norm(library, axis=0)
    rows = len(target)
    scaled = free[:, usable] / norms[usable] * np.sqrt(rows)
    deviation = max(float(np.std(target)), 1e-300)
    before = fit_columns(train.base, train.target, held.base, held.target)
    best, kept_best = before, np.zeros(0, dtype=int)
    at = np.flatnonzero(usable)
    for threshold in THRESHOLDS:
        optimizer = STLSQ(threshold=float(threshold), alpha=1e-3, max_iter=50)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns where nothing survives
            optimizer.fit(scaled, (target / deviation)[:, None])
        kept = at[np.abs(np.ravel(optimizer.coef_)) > 0]
        fit = fit_columns(
            np.column_stack([train.base, library[:, kept]]), train.target,
            np.column_stack([held.base, held_library[:, kept]]), held.target,
        )  # fmt: skip
        if fit.scores < best.scores:
            best, kept_best = fit, kept
    if not is_better_held_out(before, best):
        return []
    return list(dict.fromkeys(labels[k] for k in kept_best))
