"""Tables I and II of the paper: the muscle, its valve and its air supply, in SI."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from hal.configured import Configured

LONGEST_M = 10.0
HIGHEST_TANK_PA = 2e6
HIGHEST_ATMOSPHERE_PA = 2e5
HOTTEST_K = 1000.0
"""Beyond these a number is in another unit. A fit keeps to them too."""
ROOM_K = 293.0
"""Air of any other rig than the paper's, which says 273 K."""


class MuscleParameters(Configured):
    """Tables I and II of the paper, in SI; the defaults are the paper's values.

    A direct mechanism has mass, damping, stiffness (0: no spring) and the atmosphere of them.
    """

    mass_kg: Annotated[float, Field(ge=1e-9, le=1e9, description="M, moving mass")] = 0.05
    damping_n_s_per_m: Annotated[float, Field(ge=0, le=1e12, description="c of Eq. 5")] = 570.0
    stiffness_n_per_m: Annotated[float, Field(ge=0, le=1e12, description="k of Eq. 4")] = 9680.0
    rest_length_m: Annotated[float, Field(ge=1e-4, le=LONGEST_M, description="L_0")] = 0.200
    braid_length_m: Annotated[float, Field(ge=1e-4, le=LONGEST_M, description="b")] = 0.232
    braid_turns: Annotated[float, Field(ge=1e-3, le=1e6, description="n")] = 1.94
    kinetic_friction_per_m: Annotated[float, Field(ge=0, le=1e12, description="mu_k")] = 55.3
    braid_count: Annotated[float, Field(ge=0, le=1e6, description="N")] = 100.0
    braid_contact_area_m2: Annotated[float, Field(ge=0, le=1, description="A_b")] = 0.233e-6
    tank_pressure_pa: Annotated[float, Field(ge=1, le=HIGHEST_TANK_PA, description="absolute")] = (
        441.3e3
    )
    atmospheric_pressure_pa: Annotated[
        float, Field(ge=1, le=HIGHEST_ATMOSPHERE_PA, description="absolute")
    ] = 101.3e3
    gas_constant_j_per_kg_k: Annotated[float, Field(ge=1, le=1e6)] = 287.1
    temperature_k: Annotated[
        float,
        Field(ge=1, le=HOTTEST_K, description="of the air; of `actuator: chamber` 293 by default"),
    ] = 273.0
    heat_capacity_ratio: Annotated[float, Field(gt=1, le=2, description="gamma of Psi")] = 1.4
    valve_gain_m2_per_v: Annotated[
        float, Field(ge=1e-15, le=1, description="K_Av, including C_d")
    ] = 1.03e-6

    @model_validator(mode="after")
    def _check_contraction(self) -> MuscleParameters:
        if not self.rest_length_m < self.braid_length_m < math.sqrt(3.0) * self.rest_length_m:
            raise ValueError(
                "braid_length_m must lie between rest_length_m and 1.732 rest_length_m, "
                "or the muscle does not contract when filled (Eq. 3)"
            )
        if self.tank_pressure_pa <= self.atmospheric_pressure_pa:
            raise ValueError("tank_pressure_pa is absolute and must exceed atmospheric_pressure_pa")
        return self
