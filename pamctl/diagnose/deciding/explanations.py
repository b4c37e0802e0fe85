"""The explanations that a diagnosis leaves, as fitted models under names for people."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from pamctl.diagnose.evidence.fit import WeighedModel, Weigher
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.weigh import EvidenceVerdict
from pamctl.diagnose.extend import assemble_plant
from pamctl.plant.model import PlantSettings

if TYPE_CHECKING:
    from pamctl.diagnose.diagnosis import Diagnosis

MOST_EXPLANATIONS = 4
"""The nearest ones; each pair of them is a question to the program."""
MOST_RIVALS = 3
"""Rivals of one finding that are fitted."""


@dataclass(frozen=True)
class Explanation:
    """One explanation: its name, and the model that was fitted with it."""

    name: str
    model: WeighedModel
    weigher: Weigher
    nominal: PlantSettings

    @property
    def values(self) -> dict[str, float]:
        """The model's numbers by flat name, those of the measuring chain included."""
        return {**self.weigher.base, **self.model.values}

    @cached_property
    def plant(self) -> PlantSettings:
        """The whole plant under this explanation."""
        return assemble_plant(self.nominal, self.model.values)


def name_explanation(model: WeighedModel) -> str:
    """Return what a model says is missing, in one line."""
    return " and ".join(sorted(model.names)) or "recalibration alone"


def list_explanations(diagnosis: Diagnosis) -> tuple[Explanation, ...]:
    """Return what the data leave open: the chosen model first, then its rivals, the nearest first.

    Fewer than two explanations leave nothing to decide.
    """
    found = diagnosis.evidence
    if found is None or not found.findings:
        return ()
    models = [found.model, *(m for f in found.findings for m in _fit_rivals(found, f))]
    named = {name_explanation(m): m for m in reversed(models[:MOST_EXPLANATIONS])}
    return tuple(
        Explanation(name, m, found.weigher, diagnosis.nominal)
        for name, m in reversed([*named.items()])
    )


def _fit_rivals(found: EvidenceVerdict, finding: Finding) -> Iterator[WeighedModel]:
    """Yield the model with a finding exchanged for each of what is not beaten, fitted.

    A name's freer terms can always mimic it: they are no question to a program.
    """
    asked = [r.name for r in finding.rivals[:MOST_RIVALS]]
    if finding.level in ("name", "rest") or not asked:
        return
    search = NameSearch(found.weigher, found.pool)
    without = search.drop(found.model, finding.name)
    for name in asked:
        score = next(iter(search.score(without, [name])), None)
        if score is not None:
            yield from search.refit(without, [score], 1)[:1]
