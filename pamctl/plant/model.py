"""A plant file: which model, which parameters, which effects."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, create_model, model_validator

from hal.configured import Configured
from pamctl.plant.effects import CATALOGUE, Effects
from pamctl.plant.effects.description import EffectDescription
from pamctl.plant.parameters import PlantParameters

Positive = Annotated[float, Field(gt=0)]


class MuscleParameters(Configured):
    """Tables I and II of the paper, in SI; the defaults are the paper's values."""

    mass_kg: Annotated[float, Field(gt=0, le=100, description="M, moving mass")] = 0.05
    damping_n_s_per_m: Annotated[float, Field(gt=0, description="c of Eq. 5")] = 570.0
    stiffness_n_per_m: Annotated[float, Field(gt=0, description="k of Eq. 4")] = 9680.0
    rest_length_m: Annotated[float, Field(gt=0, le=10, description="L_0")] = 0.200
    braid_length_m: Annotated[float, Field(gt=0, le=10, description="b")] = 0.232
    braid_turns: Annotated[float, Field(gt=0, description="n")] = 1.94
    kinetic_friction_per_m: Annotated[float, Field(ge=0, description="mu_k")] = 55.3
    braid_count: Annotated[float, Field(ge=0, description="N")] = 100.0
    braid_contact_area_m2: Annotated[float, Field(ge=0, description="A_b")] = 0.233e-6
    tank_pressure_pa: Annotated[float, Field(gt=0, le=2e6, description="absolute")] = 441.3e3
    atmospheric_pressure_pa: Annotated[float, Field(gt=0, le=2e5, description="absolute")] = 101.3e3
    gas_constant_j_per_kg_k: Positive = 287.1
    temperature_k: Annotated[float, Field(gt=0, le=1000)] = 273.0
    heat_capacity_ratio: Annotated[float, Field(gt=1, le=2, description="gamma of Psi")] = 1.4
    valve_gain_m2_per_v: Annotated[float, Field(gt=0, description="K_Av, C_d inside")] = 1.03e-6

    @model_validator(mode="after")
    def _contracts_when_filled(self) -> MuscleParameters:
        if not self.rest_length_m < self.braid_length_m < math.sqrt(3.0) * self.rest_length_m:
            raise ValueError(
                "braid_length_m must lie between rest_length_m and 1.732 rest_length_m, "
                "or the muscle does not contract when filled (Eq. 3)"
            )
        if self.tank_pressure_pa <= self.atmospheric_pressure_pa:
            raise ValueError("tank_pressure_pa is absolute and must exceed atmospheric_pressure_pa")
        return self


def _settings_of(effect: EffectDescription) -> type[Configured]:
    fields: dict[str, Any] = {
        p.name: (
            Annotated[float, Field(ge=p.low, le=p.high, description=f"{p.meaning} ({p.unit})")],
            p.neutral,
        )
        for p in effect.parameters
    }
    return create_model(effect.name, __base__=Configured, **fields)


_effect_fields: dict[str, Any] = {
    name: (_settings_of(effect) | None, None) for name, effect in CATALOGUE.items()
}
EffectSettings = create_model(
    "EffectSettings",
    __base__=Configured,
    __doc__="Effects switched on, by their names in the catalogue; one left out does not act.",
    **_effect_fields,
)


class PlantSettings(Configured):
    """The model of a muscle and its valve."""

    base: Annotated[Literal["paper"], Field(description="Eq. 1 to 9")] = "paper"
    parameters: MuscleParameters = MuscleParameters()
    effects: EffectSettings = EffectSettings()


def plant_parameters(settings: PlantSettings) -> PlantParameters:
    """Turn a plant file into the numbers that the kernels use."""
    m = settings.parameters
    gamma = m.heat_capacity_ratio
    energy = m.gas_constant_j_per_kg_k * m.temperature_k
    critical = (2.0 / (gamma + 1.0)) ** (gamma / (gamma - 1.0))
    unchoked = math.sqrt(2.0 * gamma / ((gamma - 1.0) * energy))
    return PlantParameters(
        mass_kg=m.mass_kg,
        damping_n_s_per_m=m.damping_n_s_per_m,
        stiffness_n_per_m=m.stiffness_n_per_m,
        rest_length_m=m.rest_length_m,
        braid_length_m=m.braid_length_m,
        volume_scale=1.0 / (4.0 * math.pi * m.braid_turns**2),
        friction_area_m=m.kinetic_friction_per_m * m.braid_count * m.braid_contact_area_m2,
        tank_pressure_pa=m.tank_pressure_pa,
        atmospheric_pressure_pa=m.atmospheric_pressure_pa,
        specific_energy_j_per_kg=energy,
        valve_gain_m2_per_v=m.valve_gain_m2_per_v,
        inverse_gamma=1.0 / gamma,
        critical_ratio=critical,
        choked_flow_s_per_m=unchoked
        * critical ** (1.0 / gamma)
        * math.sqrt(1.0 - critical ** ((gamma - 1.0) / gamma)),
        unchoked_flow_s_per_m=unchoked,
        effects=_effects(settings),
    )


def _effects(settings: PlantSettings) -> Effects:
    switched_on = settings.effects.model_dump(exclude_none=True)
    neutral = Effects()
    return neutral._replace(
        **{name: getattr(neutral, name)._replace(**values) for name, values in switched_on.items()}
    )
