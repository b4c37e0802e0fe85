"""Confirm: what was chosen is tested once, on samples that have chosen nothing.

Before that, names that spoil the coupled simulation are withdrawn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.name import Naming
from pamctl.diagnose.naming.search import closed_share
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.naming.whiteness import ResidualSign, find_residual_signs
from pamctl.diagnose.show import CoupledComparison, HeldOutGap, compare_coupled

SILENT = (Verdict.NO_DISCREPANCY, Verdict.MISCALIBRATED)


@dataclass(frozen=True)
class Confirmation:
    """What is said in the end, and its figures on the samples that confirm."""

    naming: Naming
    signs: tuple[ResidualSign, ...]
    """What speaks against noise in a residual that is at its limit."""
    gap: Mapping[str, HeldOutGap]
    ratios: Mapping[str, float]
    """Residual over floor, by block."""
    explained: Mapping[str, float]
    """Share of the way to the limit that the effects go, by block that they reach."""


def confirm_naming(naming: Naming, confirming: Evidence) -> Confirmation:
    """Test a naming on the samples that `confirming` holds out, and measure its figures there."""
    naming, coupled = _withdraw_spoilers(naming)
    chosen = naming
    refuted = _list_refuted(naming, confirming)
    if refuted:
        naming = naming.withdraw_effects(refuted)
    base, model = (_count_on(m, naming.base, confirming) for m in (naming.base, naming.model))
    signs: tuple[ResidualSign, ...] = ()
    if naming.verdict in (*SILENT, Verdict.NAMED):
        signs = find_residual_signs(naming.model, model)
    if signs:
        less = Verdict.NONE_KNOWN if naming.verdict in SILENT else Verdict.PARTIAL
        naming = replace(naming, verdict=less)
    closes = max(_close_shares(base, model).values(), default=0.0)
    if naming.verdict is Verdict.PARTIAL and closes <= 0.0:
        naming = naming.withdraw_effects(naming.model.names)
        model = _count_on(naming.model, naming.base, confirming)
    if naming.model is not chosen.model:
        coupled = compare_coupled(naming.base, naming.model)
    return Confirmation(
        naming,
        signs,
        coupled.measure_gaps(confirming, model.floors),
        {block: model.ratio(block) for block in confirming.blocks},
        {b: s for b, s in _close_shares(base, model).items() if b in naming.base.unexplained},
    )


def _close_shares(base: Model, model: Model) -> dict[str, float]:
    """Return the share of the way to its limit that the effects go, by block that they reach."""
    reached = {block for effect in model.effects for block in effect.blocks}
    return {b: closed_share(base, model, b) for b in reached}


def _count_on(model: Model, base: Model, confirming: Evidence) -> Model:
    """Return a model that is judged by other samples, with the floors that it has."""
    return replace(model, evidence=confirming, root=base)


def _withdraw_spoilers(naming: Naming) -> tuple[Naming, CoupledComparison]:
    """Withdraw names that make the coupled simulation worse."""
    while True:
        coupled = compare_coupled(naming.base, naming.model)
        worse = coupled.list_worse_blocks(naming.base.evidence)
        spoilers = find_spoilers(naming.model, worse)
        if not spoilers:
            return naming, coupled
        naming = naming.withdraw_effects(spoilers)


def find_spoilers(model: Model, worse: frozenset[str]) -> frozenset[str]:
    """Return the effects to blame for blocks whose coupled signals became worse.

    What a block lacks shows in the coupled signals of both. So where a block that no effect reaches
    is above its limit, a worse signal says nothing against the effects; nor does the signal of a
    block that they do not reach, while something is left in theirs.
    """
    reached = {block for effect in model.effects for block in effect.blocks}
    if not worse or {*model.unexplained} - reached:
        return frozenset()
    blamed = {effect.name for effect in model.effects if effect.blocks & worse}
    return frozenset(blamed or (() if model.unexplained else model.names))


def _list_refuted(naming: Naming, confirming: Evidence) -> frozenset[str]:
    """Return the effects whose blocks are no better than without them on the confirming samples."""
    base, model = (_count_on(m, naming.base, confirming) for m in (naming.base, naming.model))
    return frozenset(
        effect.name
        for effect in model.effects
        if all(model.rms[b] >= base.rms[b] for b in effect.blocks)
    )
