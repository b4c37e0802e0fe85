"""Step 4, extend: the plant to go on with, with the named effects and the fitted numbers."""

from __future__ import annotations

from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.plant.model import PlantSettings


def extend_plant(verdict: Verdict, model: Model) -> PlantSettings:
    """Return the plant to go on with under this verdict."""
    if verdict is Verdict.NO_DISCREPANCY:
        return model.evidence.nominal
    return assemble_plant(model)


def assemble_plant(model: Model) -> PlantSettings:
    """Put the fits of the blocks together; where the geometry differs, the mechanics' counts."""
    fixed = {name: value for effect in model.effects for name, value in effect.fixed_numbers}
    return with_values(model.evidence.nominal, {**model.values, **fixed})
