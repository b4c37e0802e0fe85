"""The plant to go on with: the recalibrated numbers, and what was found."""

from __future__ import annotations

from pamctl.diagnose.evidence.pool import CHAIN
from pamctl.diagnose.evidence.run_pieces import join_waves
from pamctl.diagnose.evidence.weigh import EvidenceVerdict
from pamctl.diagnose.plant_numbers import with_values
from pamctl.plant.model import PlantSettings


def extend_plant(nominal: PlantSettings, found: EvidenceVerdict) -> PlantSettings:
    """Return the plant with the numbers of the extended model.

    What is wrong with the measuring chain stays out of it, except the pressure of the place.
    """
    return assemble_plant(nominal, found.model.values)


def assemble_plant(nominal: PlantSettings, values: dict[str, float]) -> PlantSettings:
    """Return the plant with a model's numbers; raise ValidationError if one is out of range."""
    plain, chain = join_waves(values)
    if f"{CHAIN}atmosphere" in chain:
        plain["atmospheric_pressure_pa"] = chain[f"{CHAIN}atmosphere"]
    return with_values(nominal, plain)
