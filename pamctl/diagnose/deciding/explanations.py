"""The explanations that a diagnosis leaves, as fitted models under names for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from pamctl.diagnose.extend import assemble_plant
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.diagnose.terms.describe import Description
from pamctl.plant.model import PlantSettings

MOST_EXPLANATIONS = 4
"""The nearest ones; each pair of them is a question to the program."""
NEAR = 2.0
"""A rival of a partial explanation counts if it leaves at most this multiple of what that one
leaves."""


@dataclass(frozen=True)
class Explanation:
    """One explanation: its name, and the model that was fitted with it."""

    name: str
    model: Model

    @cached_property
    def plant(self) -> PlantSettings:
        """The whole plant under this explanation."""
        return assemble_plant(self.model)


def name_explanation(model: Model) -> str:
    """Return the effects of a model in one line; without any, its numbers are the explanation."""
    return " and ".join(sorted(model.names)) or "recalibration alone"


def list_explanations(
    verdict: Verdict,
    model: Model,
    standings: Sequence[Standing],
    described: Description | None = None,
    setup: Sequence[SetupFinding] = (),
) -> tuple[Explanation, ...]:
    """Return what the data leave open: the chosen model first, then its rivals, the nearest first.

    A number of the plant file that explains the data as well is a rival too. Fewer than two
    explanations leave nothing to decide.
    """
    term = described.term if described else None
    if verdict is Verdict.DESCRIBED and term is not None:
        found = {term.text: model, **term.equal_models}
    else:
        found = {name_explanation(model): model}
        for standing in standings:
            found |= _list_rivals(verdict, model, standing)
        if verdict is Verdict.AMBIGUOUS:
            found |= _list_numbers(model, setup)
    return tuple(Explanation(*pair) for pair in [*found.items()][:MOST_EXPLANATIONS])


def _list_rivals(verdict: Verdict, model: Model, standing: Standing) -> dict[str, Model]:
    """Return the rivals of one effect that the data do not refute."""
    here = max(model.ratio(b) for b in standing.effect.blocks)
    kept = {*model.names} - {standing.effect.name}
    models = {name: m for m in standing.rival_models for name in {*m.names} - kept}
    return {
        name_explanation(models[r.name]): models[r.name]
        for r in standing.rivals
        if r.name in models
        and (r.is_equal or (verdict is Verdict.PARTIAL and r.residual_over_floor <= NEAR * here))
    }


def _list_numbers(model: Model, setup: Sequence[SetupFinding]) -> dict[str, Model]:
    """Return the model without effects, recalibrated at each number that an effect may imitate."""
    open_ones = [
        f
        for f in setup
        if f.kind == "plant_constant"
        and not f.is_corrected
        and {*f.cannot_be_told_from} & {*model.names}
    ]
    nominal = model.evidence.nominal
    return {
        f.number: recalibrate(
            replace(model.evidence, nominal=with_values(nominal, {f.number: f.value}), together={})
        )
        for f in open_ones
    }
