"""A wrong set-up beside an effect: the one hides the other, and neither alone explains the data.

A name that leaves something may have taken a neighbour for what the set-up does. So the set-up is
asked again upon the strongest effect alone, and the effects are named again on the corrected data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

from pamctl.diagnose.extend import assemble_plant
from pamctl.diagnose.fitting.block_fit import FULL
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import fit_model, recalibrate, weigh_blocks
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.diagnose.name import Naming, name_effects
from pamctl.diagnose.naming.first_level import FirstLevel
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.suspect_setup import (
    CheckedSetup,
    correct_whole_cause,
    fit_hidden_setups,
    suspect_setup,
)

MUCH_NEARER = 0.5
"""The corrected set-up is believed if the named model then leaves less than this share of the
square."""


def ask_beside(
    naming: Naming,
    setup: CheckedSetup,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Callable[[str], None],
) -> tuple[Naming, CheckedSetup]:
    """Return naming and set-up, with what the set-up hid; unchanged where nothing was hidden."""
    if not (naming.model.effects and naming.model.unexplained) or setup.findings:
        return naming, setup
    strongest = _find_strongest(naming)
    progress(f"asking the set-up beside {strongest.names[0]}")
    evidence = replace(setup.base.evidence, nominal=assemble_plant(strongest), together={})
    others = [c for c in candidates if c.name not in strongest.names]
    beside = suspect_setup(
        weigh_blocks(recalibrate(evidence)),
        setup.train,
        setup.holdout,
        FirstLevel(others),
        progress,
    )
    found = tuple(f for f in beside.findings if f.is_corrected)
    if not found or beside.refusal:
        return naming, setup
    numbers = {f.number: f.value for f in found if f.kind == "plant_constant"}
    nominal = with_values(setup.base.evidence.nominal, numbers)
    corrected = replace(beside.base.evidence, nominal=nominal, together={})
    base = weigh_blocks(recalibrate(corrected))
    # The base without the effect may be far from the valley where it was found.
    fitted = fit_model(base, strongest.effects, [beside.base.values], effort=FULL)
    again = name_effects(base, candidates, executor, progress, (fitted,))
    if _square_left(again.model) > MUCH_NEARER * _square_left(naming.model):
        return naming, setup
    checked = CheckedSetup(base, beside.train, beside.holdout, found)
    return again, checked


def ask_rival_setups(
    naming: Naming,
    setup: CheckedSetup,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Callable[[str], None],
) -> tuple[Naming, CheckedSetup]:
    """Hold effects that are not sure against the set-up.

    These are several that are equal, or one that leaves more than noise, though too little to
    matter.
    """
    named = naming.verdict is Verdict.NAMED and naming.model.leaves_signal
    if not (named or naming.verdict is Verdict.AMBIGUOUS):
        return naming, setup
    return hold_against_setups(naming, setup, candidates, executor, progress)


def hold_against_setups(
    naming: Naming,
    setup: CheckedSetup,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Callable[[str], None],
) -> tuple[Naming, CheckedSetup]:
    """Return naming and set-up, with what explains as much as the effects.

    Derivatives promise little of a wrong length or scale, so these were perhaps not fitted. Here
    they cost a few fits, and the set of what may be true is honest only with them. One that
    explains all, and clearly more than the effects, is corrected instead.
    """
    if setup.findings:
        return naming, setup
    progress(f"asking the set-up beside {' and '.join(naming.model.names)}")
    equals = [name for standing in naming.standings for name in standing.equal_rivals]
    fits, findings = fit_hidden_setups(setup.base, naming.model, equals)
    corrected = correct_whole_cause(setup, fits, naming.model)
    if corrected is None:
        return naming, replace(setup, findings=findings, open_fits=fits)
    return name_effects(corrected.base, candidates, executor, progress), corrected


def _find_strongest(naming: Naming) -> Model:
    """Return the base with the one effect of the named that leaves least."""
    if len(naming.model.effects) == 1:
        return naming.model
    singles = [fit_model(naming.base, (e,), [{}]) for e in naming.model.effects]
    return min(singles, key=_square_left)


def _square_left(model: Model) -> float:
    return sum(model.ratio(block) ** 2 for block in model.evidence.blocks)
