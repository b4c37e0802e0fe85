"""The plant's numbers as the kernels use them, and its state."""

from __future__ import annotations

from math import nan
from typing import Any, NamedTuple

from pamctl.plant.chains import (
    Effects,
    MechanicsMemory,
    SensorMemory,
    ValveMemory,
    add_force,
    make_rest_memories,
)
from pamctl.plant.effects.air.supply_ripple import ripple_pa
from pamctl.plant.effects.friction.presliding import Bristles
from pamctl.plant.terms.air_terms import LOWEST_SUPPLY_PA, pass_supply_term
from pamctl.plant.terms.mechanics_terms import MotionPoint, add_force_term
from pamctl.plant.terms.operators import TermMemory, Terms


class PaperParameters(NamedTuple):
    """The paper's Tables I and II in SI, with products computed once for all steps."""

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

    `pamctl.plant.flat.parameters_of` makes it, with consistent products and flags. Kernels of the
    paper's equations take `paper` alone, and kernels of a part's effects take that part alone.
    """

    paper: PaperParameters
    effects: Effects
    valve_acts: bool
    """Whether any effect is active in this part; otherwise the paper's equations run alone."""
    air_acts: bool
    mechanics_act: bool
    sensors_act: bool
    direct: bool
    """A measured force, and a piston if there is one, drive the mechanics instead of the muscle."""
    terms: Terms | None = None
    """None: a plant without terms does not compile them."""

    @property
    def atmospheric_pressure_pa(self) -> float:
        """Absolute pressure; for callers other than kernels."""
        return self.paper.atmospheric_pressure_pa

    @property
    def tank_pressure_pa(self) -> float:
        """Absolute pressure; for callers other than kernels."""
        return self.paper.tank_pressure_pa


class AirNow(NamedTuple):
    """What acts on the air over one step."""

    extra_kg_per_s: float
    """Extra flow into the muscle, from effects and terms."""
    tank_pa: float
    """Absolute pressure of the supply, before it droops."""


def find_tank_pa(p: PlantParameters, age_s: float) -> float:
    """Return the absolute pressure of the supply, before it droops."""
    tank_pa = p.paper.tank_pressure_pa + ripple_pa(p.effects.air.supply_ripple, age_s)
    return pass_supply_term(p.terms, max(tank_pa, LOWEST_SUPPLY_PA), age_s)


class ValveState(NamedTuple):
    """State of the valve and memories of its effects."""

    spool_v: float = 0.0
    spool_rate_v_per_s: float = 0.0
    memory: Any = ValveMemory()
    term: TermMemory | None = None
    """Memory of the valve's term; None in a plant without terms."""


class AirState(NamedTuple):
    """State of the air upstream of the muscle."""

    supply_pa: float = nan
    """Pressure upstream of the valve; of a supply with two branches, of the slow one."""
    line_pa: float = nan
    """Pressure at the line's valve end, where the sensor is; without a line, in the muscle."""
    branch_pa: float = 0.0
    """By how much a supply's fast branch lowers the pressure."""
    warmth: float = 1.0
    """Temperature of the muscle's air over that of the walls, T / T_0."""


class MechanicsState(NamedTuple):
    """State of the bristles and memories of the effects on the mechanics."""

    bristles: Bristles = Bristles()
    memory: Any = MechanicsMemory()
    term: TermMemory | None = None
    """Memory of the mechanics' term; None in a plant without terms."""


class PlantState(NamedTuple):
    """State of Eq. 9 (x, v, absolute P), and the memories of each part's effects.

    With effects, start from `rest_state` or `vented_state`: the default memories are those of a
    plant at 0 m and an unknown pressure (NaN).
    """

    position_m: float
    velocity_m_per_s: float
    pressure_pa: float
    valve: ValveState = ValveState()
    air: AirState = AirState()
    sensors: Any = SensorMemory()
    mechanics: MechanicsState = MechanicsState()
    age_s: float = 0.0
    """Time since the plant's start, for drifts."""


def rest_state(p: PlantParameters, position_m: float, pressure_pa: float) -> PlantState:
    """Return a plant that has rested for long at a position and absolute pressure."""
    of_valve, of_mechanics, of_sensors = make_rest_memories(position_m, pressure_pa)
    of_term = None if p.terms is None else TermMemory()
    return PlantState(
        position_m,
        0.0,
        pressure_pa,
        ValveState(memory=of_valve, term=of_term),
        AirState(p.paper.tank_pressure_pa, pressure_pa),
        of_sensors,
        MechanicsState(memory=of_mechanics, term=of_term),
    )


def vented_state(p: PlantParameters) -> PlantState:
    """Return the muscle at rest at atmospheric pressure: only an effect's force moves it."""
    rest_m = 0.0
    if p.mechanics_act and not p.direct:
        memory = MechanicsState().memory
        pull_n = add_force(p.effects.mechanics, memory, 0.0, 0.0, 0.0, 0.0, 0.0)
        pull_n = add_force_term(p.terms, TermMemory(), pull_n, MotionPoint(0.0, 0.0, 0.0, 0.0))
        rest_m += pull_n / p.paper.stiffness_n_per_m
    return rest_state(p, rest_m, p.paper.atmospheric_pressure_pa)
