"""Faults that no small step leads to: a wrong sign, an encoder counted four times, an atmosphere
that was added twice.

Each is one simulation with the plant file's numbers. What leaves less than the recalibrated model
is fitted from there. A direct mechanism's guesses may be far off: its balance of forces is fitted,
which is nearly linear.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from pamctl.diagnose.fitting.block_fit import fit_numbers, rms
from pamctl.diagnose.fitting.drives import (
    MECHANICS,
    PRESSURE,
    has_constant_volume,
    stack_residuals,
)
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import AREA, value_of, with_values
from pamctl.diagnose.setup.suspects import Kind, Suspect
from pamctl.diagnose.setup.weighed_fit import SuspectFit, reached_fits
from pamctl.plant.model import PlantSettings

ENCODER_FACTORS = (0.25, 0.5, 2.0, 4.0)
"""One, two or all four edges of a quadrature period, counted as another number of them."""
PROMISING = 0.8
"""A fault is fitted if it leaves less than this share of the base's RMS, with the plant file's
numbers."""


def fit_wholesale(base: Model) -> list[SuspectFit]:
    """Return the fits of those that promise something."""
    fits = []
    for suspect, amount in _list_wholesale(base):
        touched = reached_fits(base, suspect)
        start = _find_start(base, suspect, amount)
        if start is not None:
            refitted = {
                blocks: fit_numbers([suspect.apply(d, amount) for d in f.drives], start, f.free)
                for blocks, f in touched.items()
            }
            fits.append(SuspectFit(base, suspect, amount, 0.0, refitted))
    return fits


def _find_start(base: Model, suspect: Suspect, amount: float) -> PlantSettings | None:
    """Return the plant to fit from; None for a fault that does not look like the cause."""
    if base.evidence.balance:
        return _fit_balance(base, suspect, amount)
    nominal = base.evidence.nominal
    for block in suspect.blocks & {*base.unexplained}:
        altered = [suspect.apply(d, amount) for d in base.evidence.train[block]]
        before = rms(stack_residuals(base.evidence.train[block], base.fit_of(block).settings))
        if rms(stack_residuals(altered, nominal)) < PROMISING * before:
            return nominal
    return None


def _fit_balance(base: Model, suspect: Suspect, amount: float) -> PlantSettings | None:
    evidence, free = base.evidence, base.fit_of(MECHANICS).free
    as_is = fit_numbers(evidence.balance, evidence.nominal, free)
    turned = [suspect.apply(d, amount) for d in evidence.balance]
    fitted = fit_numbers(turned, evidence.nominal, free)
    # The shown force itself is the unit: a scale of the column must not count.
    share = abs(1.0 + amount)
    is_nearer = rms(fitted.residual) < PROMISING * share * rms(as_is.residual)
    return with_values(evidence.nominal, fitted.values) if is_nearer else None


def _list_wholesale(base: Model) -> Iterator[tuple[Suspect, float]]:
    blocks = frozenset(base.evidence.blocks)
    nominal = base.evidence.nominal
    if nominal.actuator == "direct":
        if base.evidence.balance:
            is_known = AREA in nominal.known  # else it is fitted, with either sign
            equal = () if is_known else ("sign of position_m",)
            yield replace(_make("sign", "force_n", blocks), always_equal=equal), -2.0
            if is_known:
                yield replace(_make("sign", AREA, blocks), scale=value_of(nominal, AREA)), -2.0
        return
    if PRESSURE in blocks:
        yield _make("sign", "valve_v", frozenset({PRESSURE})), -2.0
    if not has_constant_volume(nominal):  # a sealed chamber may start at any pressure
        yield _make("gauge", "pressure_pa", blocks), nominal.parameters.atmospheric_pressure_pa
    if MECHANICS in blocks:
        yield _make("sign", "position_m", blocks), -2.0
        for factor in ENCODER_FACTORS:
            yield _make("scale", "position_m", blocks), factor - 1.0


def _make(kind: Kind, number: str, blocks: frozenset[str]) -> Suspect:
    return Suspect(kind, number, "", -1e9, 1e9, (), 1.0, blocks, "wholesale")
