"""The model to go on with: a plant file's settings with fitted numbers and effects."""

from __future__ import annotations

from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.plant.model import PlantSettings


def assemble_plant(model: Model) -> PlantSettings:
    """Put the fits of the blocks together; the geometry is the mechanics' where they differ."""
    values: dict[str, float] = {}
    for block in sorted(model.evidence.blocks, reverse=True):
        values |= model.fit_of(block).values
    values |= {name: value for effect in model.effects for name, value in effect.fixed_numbers}
    return with_values(model.evidence.nominal, values)


def extend_plant(verdict: Verdict, model: Model) -> PlantSettings:
    """Return the plant that the verdict stands for."""
    if verdict is Verdict.NO_DISCREPANCY:
        return model.evidence.nominal
    return assemble_plant(model)
