"""From judgement and rivals to the diagnosis: what stands, what is taken back, what it closes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from pamctl.diagnose.audit import audited
from pamctl.diagnose.correction import corrected
from pamctl.diagnose.diagnosis import Diagnosis, Trial
from pamctl.diagnose.extend import extended_plant, whole_plant
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.evidence import SMALLEST
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.integrator import changes
from pamctl.diagnose.fitting.intervals import estimates
from pamctl.diagnose.locate import cells
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.naming.doubt import any_doubtful
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.search import Search, rank
from pamctl.diagnose.naming.verdict import Judgement, Verdict, after_rivals
from pamctl.diagnose.remainder import Remainder, remainder
from pamctl.diagnose.show import Gap, gaps
from pamctl.plant.model import PlantSettings


def refused(plant: PlantSettings, reason: str) -> Diagnosis:
    """Return the diagnosis of data that cannot be diagnosed."""
    return Diagnosis(Verdict.BAD_DATA, plant, plant, reason)


def concluded(
    judgement: Judgement,
    heard: Sequence[Standing],
    search: Search,
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
    verdict = after_rivals(judgement, heard)
    plants = {
        "nominal": evidence.nominal,
        "recalibrated": whole_plant(search.base),
        "extended": whole_plant(model),
    }
    gap = gaps(evidence, holdout, plants)
    numbers = estimates(model)
    doubtful = verdict is not Verdict.PARTIAL and any_doubtful(model, search, numbers)
    taken_back = model.effects and (doubtful or verdict is Verdict.NONE_KNOWN)
    if taken_back or (model.effects and not _better(gap)):
        verdict, model, heard = Verdict.NONE_KNOWN, search.base, ()
        gap = gaps(evidence, holdout, {**plants, "extended": plants["recalibrated"]})
    plant = extended_plant(verdict, model)
    left = _remainder(verdict, model)
    added = corrected(model, plant, holdout) if correction and left is not None else None
    if added and added.blocks:
        gap = {name: replace(g, corrected=added.after[name]) for name, g in gap.items()}
    return Diagnosis(
        verdict,
        evidence.nominal,
        added.plant if added else plant,
        model=model,
        base=search.base,
        standings=tuple(heard),
        numbers=numbers if model is judgement.model else estimates(model),
        gap=gap,
        cells=tuple(cells(model)),
        regimes=tuple(cells(search.base)),
        stepping=changes(model),
        tried=tuple(_tried(search)),
        remainder=left,
        corrected=added,
        train=tuple(train),
        holdout=tuple(holdout),
        explained=judgement.explained if model.effects else 0.0,
        audit=audited(model, [c for c in asked if c.name not in model.names], pairs=False),
    )


def _better(gap: dict[str, Gap]) -> bool:
    """An overlay must not make any signal's coupled gap worse than it was without.

    A twentieth, and what is too small to matter, count as equal.
    """
    return all(
        g.extended <= 1.05 * min(g.nominal, g.recalibrated) + SMALLEST[name]
        for name, g in gap.items()
    )


def _tried(search: Search) -> Iterator[Trial]:
    models = [model for level in search.levels for model in level]
    for model in sorted(models, key=rank):
        yield Trial(model.names, {b: model.ratio(b) for b in model.evidence.blocks})


def _remainder(verdict: Verdict, model: Model) -> Remainder | None:
    """Look at the shape of what is left, where something is."""
    if verdict not in (Verdict.PARTIAL, Verdict.NONE_KNOWN):
        return None
    return remainder(model, max(model.evidence.blocks, key=model.ratio))
