"""Numbers of the plant as the kernels use them, and what it remembers."""

from __future__ import annotations

from math import inf, nan
from typing import Any, NamedTuple

from pamctl.plant.chains import (
    Effects,
    MechanicsMemory,
    SensorMemory,
    ValveMemory,
    add_force,
    remember_rest,
)
from pamctl.plant.correction_tables import Correction


class PaperParameters(NamedTuple):
    """The paper's Tables I and II in SI, with the products that every step would repeat."""

    mass_kg: float
    damping_n_s_per_m: float
    """c of Eq. 5."""
    stiffness_n_per_m: float
    """k of Eq. 4."""
    rest_length_m: float
    """L_0 of Eq. 1."""
    braid_length_m: float
    """b of Eq. 2."""
    volume_scale: float
    """1 / (4 pi n^2) of Eq. 2 and 3."""
    friction_area_m: float
    """mu_k N A_b of Eq. 5. mu_k carries 1/m there, hence m^2/m."""
    tank_pressure_pa: float
    atmospheric_pressure_pa: float
    specific_energy_j_per_kg: float
    """R T of Eq. 7."""
    valve_gain_m2_per_v: float
    """K_Av of Eq. 8, discharge coefficient included."""
    inverse_gamma: float
    """1 / gamma, the exponent of the unchoked flow."""
    critical_ratio: float
    """C_r: at or below this pressure ratio the flow is choked."""
    choked_flow_s_per_m: float
    """Psi / p_upstream when choked."""
    unchoked_flow_s_per_m: float
    """Scale of Psi / p_upstream when not choked."""


class PlantParameters(NamedTuple):
    """The paper's numbers and those of the effects.

    Made by `pamctl.plant.flat.parameters_of`, which keeps products and flags true. Kernels of the
    paper's equations take `paper` alone, those of a part's effects what that part needs: a
    compiled call hands over every number of a tuple.
    """

    paper: PaperParameters
    effects: Effects
    valve_acts: bool
    """Whether any effect acts in this part; where none does, the paper's equations run alone."""
    air_acts: bool
    mechanics_act: bool
    sensors_act: bool
    direct: bool
    """A measured force drives the mechanics in the place of the muscle."""
    correction: Correction = Correction()

    @property
    def atmospheric_pressure_pa(self) -> float:
        """Absolute; for those outside of the kernels."""
        return self.paper.atmospheric_pressure_pa

    @property
    def tank_pressure_pa(self) -> float:
        """Absolute; for those outside of the kernels."""
        return self.paper.tank_pressure_pa


class AirParameters(NamedTuple):
    """What the air's part of a step needs."""

    paper: PaperParameters
    effects: Any
    """`AirEffects`."""
    extra_kg_per_s: float
    """Into the muscle over this step, by effects of that place and an unnamed correction."""


def take_air_parameters(p: PlantParameters, extra_kg_per_s: float) -> AirParameters:
    """Return what the air's part of a step needs."""
    return AirParameters(p.paper, p.effects.air, extra_kg_per_s)


class MechanismParameters(NamedTuple):
    """What the mechanics' part of a step needs."""

    paper: PaperParameters
    effects: Any
    """`MechanicsEffects`."""
    direct: bool
    extra_n: float
    """Of pull over this step, by an unnamed correction."""


class ValveState(NamedTuple):
    """What the valve remembers, for the effects that make it remember."""

    spool_v: float = 0.0
    spool_rate_v_per_s: float = 0.0
    memory: Any = ValveMemory()


class AirState(NamedTuple):
    """What the air before the muscle remembers."""

    supply_pa: float = nan
    """Upstream of the valve."""
    line_pa: float = nan
    """At the valve's end of the line, where the sensor sits; the muscle's own without a line."""


class MechanicsState(NamedTuple):
    """What the mechanics remember."""

    bristle_n: float = inf
    """Force of the bristles; infinite where they have not been loaded yet."""
    memory: Any = MechanicsMemory()


class PlantState(NamedTuple):
    """State of Eq. 9 (x, v, absolute P), and each part's memory for its effects.

    With effects take `rest_state` or `vented_state`: by default the memories are those of a plant
    at 0 m and an unknown pressure (NaN).
    """

    position_m: float
    velocity_m_per_s: float
    pressure_pa: float
    valve: ValveState = ValveState()
    air: AirState = AirState()
    sensors: Any = SensorMemory()
    mechanics: MechanicsState = MechanicsState()
    age_s: float = 0.0
    """Since the plant's first moment, for what drifts."""


def rest_state(p: PlantParameters, position_m: float, pressure_pa: float) -> PlantState:
    """Return a plant that has rested for long at a position and absolute pressure."""
    of_valve, of_mechanics, of_sensors = remember_rest(position_m, pressure_pa)
    return PlantState(
        position_m,
        0.0,
        pressure_pa,
        ValveState(memory=of_valve),
        AirState(p.paper.tank_pressure_pa, pressure_pa),
        of_sensors,
        MechanicsState(memory=of_mechanics),
    )


def vented_state(p: PlantParameters) -> PlantState:
    """Return the muscle at rest at atmospheric pressure: only an effect's force moves it."""
    pull_n = 0.0
    if p.mechanics_act and not p.direct:
        memory = MechanicsState().memory
        pull_n = add_force(p.effects.mechanics, memory, 0.0, 0.0, 0.0, 0.0, 0.0)
    return rest_state(p, 0.0 + pull_n / p.paper.stiffness_n_per_m, p.paper.atmospheric_pressure_pa)
