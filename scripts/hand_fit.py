"""Ordinary least squares on a measured record: what a few lines by hand reach.

A term is an expression over the record's columns: `t x p f u` (s, m, gauge Pa, N, V), the speed `v`
and the acceleration `a` of the displacement, and the functions of `FUNCTIONS`.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FUNCTIONS = {
    "sgn": np.sign,
    "abs": np.abs,
    "exp": np.exp,
    "sqrt": np.sqrt,
    "tanh": np.tanh,
    "sin": np.sin,
    "cos": np.cos,
}
NAMES = ("t", "x", "p", "f", "u", "v", "a")
_ALLOWED = (
    ast.Expression, ast.BinOp, ast.UnaryOp, ast.Call, ast.Name, ast.Load, ast.Constant,
    ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.USub, ast.UAdd,
)  # fmt: skip
GAP_PERIODS = 5.0
"""A pause of the logger that is longer than this many periods: no slope reaches across it."""


@dataclass(frozen=True)
class HandFit:
    """What is fitted: a column, its terms, and the terms of the model to compare with."""

    target: str
    terms: tuple[str, ...]
    base: tuple[str, ...]
    slope_s: float
    """The length of the straight line whose slope is the speed."""
    steady_s: float = 0.0
    """Above 0, a second pair of figures leaves out the rows nearer than this to a reversal."""


@dataclass(frozen=True)
class HandFigures:
    """RMS of what the terms leave of the target, in the target's unit."""

    coefficients: dict[str, float]
    fitted: float
    held_out: float
    base_fitted: float
    base_held_out: float


def slope_of(t_s: Array, values: Array, width_s: float) -> Array:
    """Return the slope of the straight line through `width_s` around each row, shape (rows,).

    Lines end at gaps. A row that is alone has slope 0.
    """
    period = float(np.median(np.diff(t_s)))
    piece = np.concatenate([[0], np.cumsum(np.diff(t_s) > GAP_PERIODS * period)])
    slopes = np.zeros_like(values)
    for k in range(int(piece[-1]) + 1):
        rows = np.flatnonzero(piece == k)
        t, y = t_s[rows] - t_s[rows[0]], values[rows] - values[rows[0]]
        low = np.searchsorted(t, t - 0.5 * width_s - 1e-9)
        high = np.searchsorted(t, t + 0.5 * width_s + 1e-9)
        n = high - low
        st, sy, stt, sty = (_sum(z, low, high) for z in (t, y, t * t, t * y))
        spread = n * stt - st * st
        slopes[rows] = np.where(n > 1, (n * sty - st * sy) / np.where(n > 1, spread, 1.0), 0.0)
    return slopes


def _sum(values: Array, low: NDArray[np.int64], high: NDArray[np.int64]) -> Array:
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(total[high] - total[low])


def evaluate(term: str, columns: Mapping[str, Array]) -> Array:
    """Return a term over the rows. Raise ValueError where it is no expression of known names."""
    tree = ast.parse(term, mode="eval")
    for node in ast.walk(tree):
        if not isinstance(node, _ALLOWED):
            raise ValueError(f"hand fit: {term!r} may hold + - * / ** and functions only")
        if isinstance(node, ast.Name) and node.id not in (*columns, *FUNCTIONS):
            raise ValueError(
                f"hand fit: {term!r} holds {node.id!r}, which this record lacks; it has "
                f"{' '.join(columns)}, and the functions {' '.join(FUNCTIONS)}"
            )
    value = eval(compile(tree, term, "eval"), {"__builtins__": {}}, {**FUNCTIONS, **columns})
    rows = len(next(iter(columns.values())))
    return np.broadcast_to(np.asarray(value, dtype=float), (rows,))


def columns_of(record: Mapping[str, Array], slope_s: float) -> dict[str, Array]:
    """Return the names that terms may use, from a record's columns in SI (pressure: gauge)."""
    short = {"t_s": "t", "position_m": "x", "gauge_pa": "p", "force_n": "f", "valve_v": "u"}
    columns = {short[name]: values for name, values in record.items() if name in short}
    if "x" in columns:
        columns["v"] = slope_of(columns["t"], columns["x"], slope_s)
        columns["a"] = slope_of(columns["t"], columns["v"], slope_s)
    return columns


def steady_rows(columns: Mapping[str, Array], margin_s: float) -> NDArray[np.bool_]:
    """Return the rows that no reversal is near: `margin_s` to either side."""
    t, v = columns["t"], columns["v"]
    turns = t[1:][np.sign(v[1:]) != np.sign(v[:-1])]
    steady = np.ones(len(t), dtype=np.bool_)
    for low, high in zip(
        np.searchsorted(t, turns - margin_s), np.searchsorted(t, turns + margin_s), strict=True
    ):
        steady[low:high] = False
    return steady


def fit_by_hand(
    plan: HandFit,
    fitted: Sequence[Mapping[str, Array]],
    held_out: Sequence[Mapping[str, Array]],
    *,
    steady: bool = False,
) -> HandFigures:
    """Fit on some records, judge on others; records as `columns_of` returns them."""
    fit = [_rows(plan, columns, steady) for columns in fitted]
    judge = [_rows(plan, columns, steady) for columns in held_out]
    weights, left, left_out = _least_squares(plan.terms, plan.target, fit, judge)
    _, base, base_out = _least_squares(plan.base, plan.target, fit, judge)
    return HandFigures(dict(zip(plan.terms, weights, strict=True)), left, left_out, base, base_out)


def _rows(plan: HandFit, columns: Mapping[str, Array], steady: bool) -> dict[str, Array]:
    if not steady:
        return dict(columns)
    kept = steady_rows(columns, plan.steady_s)
    return {name: values[kept] for name, values in columns.items()}


def _least_squares(
    terms: Sequence[str],
    target: str,
    fit: Sequence[Mapping[str, Array]],
    judge: Sequence[Mapping[str, Array]],
) -> tuple[list[float], float, float]:
    matrix, wanted = _stack(terms, target, fit)
    scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    weights = np.linalg.lstsq(matrix / scale, wanted, rcond=None)[0] / scale
    figures = []
    for records in (fit, judge):
        rows, values = _stack(terms, target, records)
        figures.append(float(np.sqrt(np.mean((rows @ weights - values) ** 2))))
    return [float(w) for w in weights], figures[0], figures[1]


def _stack(
    terms: Sequence[str], target: str, records: Sequence[Mapping[str, Array]]
) -> tuple[Array, Array]:
    rows = [np.column_stack([evaluate(term, r) for term in terms]) for r in records]
    return np.concatenate(rows), np.concatenate([evaluate(target, r) for r in records])
