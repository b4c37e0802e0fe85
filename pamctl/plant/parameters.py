"""Numbers of the plant as the kernels use them; `model.py` makes them from a plant file."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects import Effects


class PlantParameters(NamedTuple):
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
    effects: Effects = Effects()


class PlantState(NamedTuple):
    """State of Eq. 9 (x, v, absolute P) and of the effects that have one."""

    position_m: float
    velocity_m_per_s: float
    pressure_pa: float
    spool_v: float = 0.0
    spool_rate_v_per_s: float = 0.0


def vented(parameters: PlantParameters) -> PlantState:
    """Return the muscle at rest at atmospheric pressure: it does not contract."""
    return PlantState(0.0, 0.0, parameters.atmospheric_pressure_pa)
