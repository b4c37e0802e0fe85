"""Faults that no small step leads to: a wrong sign, an encoder counted four times.

Each is one simulation with the plant file's numbers. What leaves less than the recalibrated model
is fitted from there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from pamctl.diagnose.fitting.block_fit import fit_numbers, rms
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, stack_residuals
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import AREA, value_of
from pamctl.diagnose.setup.suspects import Kind, Suspect
from pamctl.diagnose.setup.weighed_fit import SuspectFit, reached_fits

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
        if _is_promising(base, suspect, amount):
            refitted = {
                blocks: fit_numbers(
                    [suspect.apply(d, amount) for d in f.drives], base.evidence.nominal, f.free
                )
                for blocks, f in touched.items()
            }
            fits.append(SuspectFit(base, suspect, amount, 0.0, refitted))
    return fits


def _is_promising(base: Model, suspect: Suspect, amount: float) -> bool:
    return any(
        rms(
            stack_residuals(
                [suspect.apply(d, amount) for d in base.evidence.train[block]],
                base.evidence.nominal,
            )
        )
        < PROMISING * rms(stack_residuals(base.evidence.train[block], base.fit_of(block).settings))
        for block in suspect.blocks & {*base.unexplained}
    )


def _list_wholesale(base: Model) -> Iterator[tuple[Suspect, float]]:
    blocks = frozenset(base.evidence.blocks)
    if PRESSURE in blocks:
        yield _make("sign", "valve_v", frozenset({PRESSURE})), -2.0
    if MECHANICS in blocks:
        own = frozenset({MECHANICS})
        if any(d.is_equation for d in base.evidence.train[MECHANICS]):
            yield _make("sign", "force_n", own), -2.0
        nominal = base.evidence.nominal
        if AREA in nominal.known:  # else it is fitted, with either sign
            yield replace(_make("sign", AREA, own), scale=value_of(nominal, AREA)), -2.0
        yield _make("sign", "position_m", blocks), -2.0
        for factor in ENCODER_FACTORS:
            yield _make("scale", "position_m", blocks), factor - 1.0


def _make(kind: Kind, number: str, blocks: frozenset[str]) -> Suspect:
    return Suspect(kind, number, "", -1e9, 1e9, (), 1.0, blocks, "wholesale")
