"""The shape of what no known effect explains: a sparse sum of terms, never a cause.

The residual of a block is regressed on its signals and their simplest products. The terms are
a hint where to look; they are printed as an unnamed correction and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.fitting.drives import MECHANICS, Drive
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.judging.segments import differentiate
from pamctl.diagnose.measured.record import Array

MOST_TERMS = 3
LEAST_GAIN = 0.05
"""A term that explains a smaller share of the remaining square is left out."""
SMOOTH_S = 0.041
"""Length of the parabolas that differentiate position and pressure."""


@dataclass(frozen=True)
class Remainder:
    """An unnamed correction: the residual of a block as a sum of terms."""

    block: str
    unit: str
    terms: tuple[tuple[str, float], ...]
    """Term and coefficient, on signals scaled to their largest magnitude."""
    explained: float
    """Share of the residual's square."""

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        return {
            "block": self.block,
            "label": "unnamed correction, not a cause",
            "terms": [{"term": term, "coefficient": value} for term, value in self.terms],
            "unit": self.unit,
            "explained": self.explained,
        }


def regress_remainder(model: Model, block: str) -> Remainder:
    """Regress the residual of a block on its signals, one best term after the other."""
    rows: dict[str, list[Array]] = {}
    target = []
    for drive in model.evidence.train[block]:
        for term, values in _build_terms(drive).items():
            rows.setdefault(term, []).append(values if drive.rows is None else values[drive.rows])
        target.append(drive.residual(model.fit_of(block).settings) * drive.deviation)
    library = {term: np.concatenate(parts) for term, parts in rows.items()}
    unit, factor = ("um", 1e6) if block == MECHANICS else ("kPa", 1e-3)
    terms, explained = _choose_terms(library, factor * np.concatenate(target))
    return Remainder(block, unit, terms, explained)


def _build_terms(drive: Drive) -> dict[str, Array]:
    """Signals and their simplest products, each scaled to its largest magnitude."""
    period_s = float(np.median(drive.step_s))
    if drive.block == MECHANICS:
        position, load = drive.position_m, drive.load - drive.load[0]
        rate = differentiate(position, period_s, SMOOTH_S, 1)
        base = {"x": position, "P": load, "v": rate}
        extra = {"sgn v": np.tanh(rate / 1e-3), "|v|": np.abs(rate)}
    else:
        rate = differentiate(drive.measured, period_s, SMOOTH_S, 1)
        base = {"u": drive.valve_v, "P": drive.measured - drive.measured[0], "x": drive.driven}
        extra = {"dP/dt": rate, "|u|": np.abs(drive.valve_v), "sgn u": np.sign(drive.valve_v)}
    one = {name: _scale_signal(values) for name, values in {**base, **extra}.items()}
    names = list(base)
    products = {
        f"{a} {b}": one[a] * one[b] for i, a in enumerate(names) for b in [*names[i:], *extra]
    }
    return {"1": np.ones(len(drive.measured)), **one, **products}


def _scale_signal(values: Array) -> Array:
    largest = float(np.abs(values).max())
    return values / largest if largest > 0.0 else values


def _choose_terms(
    library: Mapping[str, Array], target: Array
) -> tuple[tuple[tuple[str, float], ...], float]:
    chosen: list[str] = []
    total = float(target @ target) or 1.0
    left = total
    weights: Array = np.zeros(0)
    for _ in range(MOST_TERMS):
        tried = {}
        for term in library:
            if term not in chosen:
                columns = np.column_stack([library[t] for t in (*chosen, term)])
                fitted = np.linalg.lstsq(columns, target, rcond=None)[0]
                tried[term] = (float(np.sum((target - columns @ fitted) ** 2)), fitted)
        best = min(tried, key=lambda term: tried[term][0])
        if left - tried[best][0] < LEAST_GAIN * left:
            break
        left, weights = tried[best][0], np.asarray(tried[best][1], dtype=np.float64)
        chosen.append(best)
    terms = tuple((term, float(w)) for term, w in zip(chosen, weights, strict=True))
    return terms, 1.0 - left / total
