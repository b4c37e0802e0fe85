"""The explanations that a diagnosis leaves, as fitted models under names for people."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pamctl.diagnose.evidence.fit import WeighedModel, Weigher
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.weigh import EvidenceVerdict
from pamctl.diagnose.extend import assemble_plant
from pamctl.plant.model import PlantSettings

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


def list_explanations(found: EvidenceVerdict, nominal: PlantSettings) -> tuple[Explanation, ...]:
    """Return what the data leave open: the chosen model first, then its rivals, the nearest first.

    Fewer than two explanations leave nothing to decide.
    """
    if not found.findings:
        return ()
    search, weigher = NameSearch(found.weigher, found.pool), found.weigher
    named, floor2 = {name_explanation(found.model): replace(found.model)}, weigher.like.least2
    for finding in found.findings:
        if finding.level in ("name", "rest"):  # a name's freer terms can always mimic it
            continue
        for m in _fit_rivals(search, found.model, finding):
            named.setdefault(name_explanation(m), m)
        floor2 = np.maximum(floor2, weigher.floor2)
    # As the ladder weighs them: under the resolution of the model without the finding.
    weigher.floor2 = floor2
    return tuple(
        Explanation(name, weigher.leave_out(m), weigher, nominal)
        for name, m in [*named.items()][:MOST_EXPLANATIONS]
    )


def _fit_rivals(search: NameSearch, m: WeighedModel, finding: Finding) -> Iterator[WeighedModel]:
    """Yield the model with a finding exchanged for each of what is not beaten, names first."""
    for rival in sorted(finding.rivals, key=lambda r: r.is_term)[:MOST_RIVALS]:
        fitted = exchange_name(search, m, finding.name, rival.name)
        if fitted is not None:
            yield fitted


def exchange_name(search: NameSearch, m: WeighedModel, gone: str, new: str) -> WeighedModel | None:
    """Return a model with one name instead of another, fitted; None where the new does nothing.

    An empty name stands for none. The floor is that of the model without either.
    """
    without = search.drop(m, gone) if gone else m
    if not new:
        return without
    score, weigher = next(iter(search.score(without, [new])), None), search.weigher
    if score is None:
        return None
    floor2 = weigher.floor2
    fitted = weigher.settle(search.refit(without, [score], 1)[0])
    weigher.floor2 = floor2
    return weigher.leave_out(fitted)
