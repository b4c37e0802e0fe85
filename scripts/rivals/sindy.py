"""PySINDy's sparse regression (STLSQ) over the library of the catalogue's columns.

Each effect enters in the form that explains most alone: neighbours on a grid are nearly the same
column, and thresholds then keep all or none. The base is projected out, the columns are normalised.
Of the thresholds of a grid the sparsest model is taken that is about as good as the best on the
held-out rows. Names are those of the columns that survive.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from block_rows import Array, Block, make_blocks
from naming import HELD_OUT_GAIN, Fit, fit_columns, is_better_held_out, make_verdict

THRESHOLDS = np.geomspace(0.01, 3.0, 20)
"""In standard deviations of the target: the columns have a mean square of 1."""


def diagnose_task(task: Any) -> dict[str, Any]:
    """Return a verdict on a task of the benchmark."""
    blocks = make_blocks(task.train, task.held_out, task.card)
    names = [name for train, held in blocks.values() for name in select_names(train, held)]
    return make_verdict([[name] for name in names], discrepancy=bool(names), sure=True)


def select_names(train: Block, held: Block) -> list[str]:
    """Return the effects whose columns survive, or nothing where the held-out rows do not gain."""
    from pysindy import STLSQ

    start = fit_columns(train.base, train.target, held.base, held.target)
    labels, library, held_library = _build_library(train, held)
    basis = np.linalg.qr(train.base / np.maximum(np.linalg.norm(train.base, axis=0), 1e-300))[0]
    free = library - basis @ (basis.T @ library)
    norms = np.linalg.norm(free, axis=0)
    at = np.flatnonzero(norms > 1e-6 * np.linalg.norm(library, axis=0))
    scaled = free[:, at] / norms[at] * np.sqrt(len(free))
    target = start.left / max(float(np.std(start.left)), 1e-300)
    fits: list[tuple[Fit, Array]] = []
    for threshold in THRESHOLDS:
        optimizer = STLSQ(threshold=float(threshold), alpha=1e-3, max_iter=50)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns where nothing survives
            optimizer.fit(scaled, target[:, None])
        kept = at[np.abs(np.ravel(optimizer.coef_)) > 0]
        columns = np.column_stack([train.base, library[:, kept]])
        held_columns = np.column_stack([held.base, held_library[:, kept]])
        fits.append((fit_columns(columns, train.target, held_columns, held.target), kept))
    left = [float(np.mean(fit.held_out**2)) for fit, _ in fits]
    enough = min(left) + HELD_OUT_GAIN * float(np.mean(start.held_out**2))
    good = [one for one, each in zip(fits, left, strict=True) if each <= enough]
    best, kept = min(good, key=lambda one: len(one[1]))
    if not is_better_held_out(start, start, best):
        return []
    return list(dict.fromkeys(labels[k] for k in kept))


def _build_library(train: Block, held: Block) -> tuple[list[str], Array, Array]:
    """Return names, columns and held-out columns, each effect in the form that is best alone."""
    labels: list[str] = []
    chosen: list[tuple[Array, Array]] = []
    for name, forms in train.effects.items():
        pairs = [*zip(forms, held.effects[name], strict=True)]
        best = min(pairs, key=lambda pair: _score_alone(train, held, *pair))
        labels += [name] * best[0].shape[1]
        chosen.append(best)
    columns, held_columns = (np.column_stack(side) for side in zip(*chosen, strict=True))
    return labels, columns, held_columns


def _score_alone(train: Block, held: Block, form: Array, held_form: Array) -> float:
    columns = np.column_stack([train.base, form])
    held_columns = np.column_stack([held.base, held_form])
    return fit_columns(columns, train.target, held_columns, held.target).scores
