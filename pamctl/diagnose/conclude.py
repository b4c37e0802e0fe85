"""From judgement and rivals to the diagnosis: what stands, what is taken back, what it closes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from pamctl.diagnose.audit import audit_model
from pamctl.diagnose.correction import add_correction_tables
from pamctl.diagnose.diagnosis import Diagnosis, EffectsTrial
from pamctl.diagnose.extend import assemble_plant, extend_plant
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.evidence import SMALLEST_MISFIT
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.integrator import compare_substeps
from pamctl.diagnose.fitting.intervals import estimate_intervals
from pamctl.diagnose.locate import locate_misfits
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.naming.doubt import has_doubtful_effect
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.search import EffectSearch, rank
from pamctl.diagnose.naming.verdict import Judgement, Verdict, revise_verdict
from pamctl.diagnose.remainder import Remainder, regress_remainder
from pamctl.diagnose.show import HeldOutGap, measure_gaps
from pamctl.plant.model import PlantSettings


def refuse_diagnosis(plant: PlantSettings, reason: str) -> Diagnosis:
    """Return the diagnosis of data that cannot be diagnosed."""
    return Diagnosis(Verdict.BAD_DATA, plant, plant, reason)


def conclude_diagnosis(
    judgement: Judgement,
    heard: Sequence[Standing],
    search: EffectSearch,
    train: Sequence[Record],
    holdout: Sequence[Record],
    asked: Sequence[Candidate],
    *,
    correction: bool = False,
) -> Diagnosis:
    """Draw up the diagnosis; take back names that make the coupled model worse.

    With `correction` what is left without a name is added to the model as a table.
    """
    model = judgement.model
    evidence = model.evidence
    verdict = revise_verdict(judgement, heard)
    plants = {
        "nominal": evidence.nominal,
        "recalibrated": assemble_plant(search.base),
        "extended": assemble_plant(model),
    }
    gap = measure_gaps(evidence, holdout, plants)
    numbers = estimate_intervals(model)
    doubtful = verdict is not Verdict.PARTIAL and has_doubtful_effect(model, search, numbers)
    taken_back = model.effects and (doubtful or verdict is Verdict.NONE_KNOWN)
    if taken_back or (model.effects and not _is_no_worse(gap)):
        verdict, model, heard = Verdict.NONE_KNOWN, search.base, ()
        gap = measure_gaps(evidence, holdout, {**plants, "extended": plants["recalibrated"]})
    plant = extend_plant(verdict, model)
    left = _find_remainder(verdict, model)
    added = (
        add_correction_tables(model, plant, holdout) if correction and left is not None else None
    )
    if added and added.blocks:
        gap = {name: replace(g, corrected=added.after[name]) for name, g in gap.items()}
    return Diagnosis(
        verdict,
        evidence.nominal,
        added.plant if added else plant,
        model=model,
        base=search.base,
        standings=tuple(heard),
        numbers=numbers if model is judgement.model else estimate_intervals(model),
        gap=gap,
        cells=tuple(locate_misfits(model)),
        regimes=tuple(locate_misfits(search.base)),
        stepping=compare_substeps(model),
        tried=tuple(_list_trials(search)),
        remainder=left,
        corrected=added,
        train=tuple(train),
        holdout=tuple(holdout),
        explained=judgement.explained if model.effects else 0.0,
        audit=audit_model(model, [c for c in asked if c.name not in model.names], pairs=False),
    )


def _is_no_worse(gap: dict[str, HeldOutGap]) -> bool:
    """An overlay must not make any signal's coupled gap worse than it was without.

    A twentieth, and what is too small to matter, count as equal.
    """
    return all(
        g.extended <= 1.05 * min(g.nominal, g.recalibrated) + SMALLEST_MISFIT[name]
        for name, g in gap.items()
    )


def _list_trials(search: EffectSearch) -> Iterator[EffectsTrial]:
    models = [model for level in search.levels for model in level]
    for model in sorted(models, key=rank):
        yield EffectsTrial(model.names, {b: model.ratio(b) for b in model.evidence.blocks})


def _find_remainder(verdict: Verdict, model: Model) -> Remainder | None:
    """Look at the shape of what is left, where something is."""
    if verdict not in (Verdict.PARTIAL, Verdict.NONE_KNOWN):
        return None
    return regress_remainder(model, max(model.evidence.blocks, key=model.ratio))
