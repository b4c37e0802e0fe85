"""The effects of the catalogue that promise most for one base, for those who ask before a search.

Scores are kept with the fit, so a search upon the same base does not compute them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pamctl.diagnose.fitting.candidates import Candidate, select_reaching
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import fit_model
from pamctl.diagnose.naming.score import score_candidates
from pamctl.diagnose.naming.search import fit_to_end_if_near
from pamctl.diagnose.naming.shortlist import list_returns, shortlist_candidates

WIDTH = 3


@dataclass(frozen=True)
class FirstLevel:
    """Single effects upon a base."""

    candidates: Sequence[Candidate]

    def promise(self, base: Model, block: str) -> float:
        """Return the largest share of a block's residual that an effect promises to explain."""
        own = select_reaching(self.candidates, {block})
        scores = score_candidates(base.fit_of(block), own, block)
        return max((s.explained for s in scores), default=0.0)

    def fit(self, base: Model) -> list[Model]:
        """Return the base with each of the most promising effects, fitted."""
        fitted = [
            fit_model(base, (s.candidate,), [s.start, *list_returns(base, s)])
            for s in shortlist_candidates(base, self.candidates, WIDTH)
        ]
        return [fit_to_end_if_near(model) for model in fitted]
