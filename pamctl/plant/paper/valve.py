"""Mass flow through the valve: an isentropic orifice (Eq. 8, Psi)."""

from __future__ import annotations

from math import pow, sqrt

from pamctl.plant.parameters import PaperParameters


def orifice_flow(p: PaperParameters, upstream_pa: float, downstream_pa: float) -> float:
    """Return Psi(P_u, P_d): mass flow per aperture area, kg/(s m^2), for P_u >= P_d > 0."""
    ratio = downstream_pa / upstream_pa
    if ratio <= p.critical_ratio:
        return p.choked_flow_s_per_m * upstream_pa
    # r^(1/gamma) sqrt(1 - r^((gamma-1)/gamma)) with a single power, by
    # r^((gamma-1)/gamma) = r / r^(1/gamma).
    throat = pow(ratio, p.inverse_gamma)
    drop = 1.0 - ratio / throat
    if drop <= 0.0:
        return 0.0
    return p.unchoked_flow_s_per_m * upstream_pa * throat * sqrt(drop)


def valve_flow(p: PaperParameters, opening_v: float, pressure_pa: float) -> float:
    """Return the mass flow into the muscle, kg/s, with A_v = K_Av u.

    u > 0 opens to the tank, u < 0 to the atmosphere. Air flows towards the lower pressure, so a
    muscle stretched below atmospheric pressure sucks in air.
    """
    source_pa = p.tank_pressure_pa if opening_v > 0.0 else p.atmospheric_pressure_pa
    area = p.valve_gain_m2_per_v * abs(opening_v)
    if source_pa >= pressure_pa:
        return area * orifice_flow(p, source_pa, pressure_pa)
    return -area * orifice_flow(p, pressure_pa, source_pa)
