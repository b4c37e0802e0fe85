"""The paper's geometry and flow, once more: Eqs. 1 to 3, and the nozzle of its refs. 8 and 9."""

from __future__ import annotations

import math


def volume(p, x, gauge_pa):
    """Eq. 2, with a braid that may stretch and a volume that never empties."""
    length = p.rest_length_m - p.cap_m - x
    braid = p.braid_m * (1.0 + p.stretch_per_pa * gauge_pa)
    room = length * (braid * braid - length * length) / (4.0 * math.pi * (p.turns * p.turns))
    return room + p.dead_m3 + p.hose_m3_per_pa * max(gauge_pa, 0.0)


def pull_area(p, x, gauge_pa):
    """Eq. 3 divided by the pressure: -dV/dL."""
    length = p.rest_length_m - p.cap_m - x
    braid = p.braid_m * (1.0 + p.stretch_per_pa * gauge_pa)
    return (3.0 * (length * length) - braid * braid) / (4.0 * math.pi * (p.turns * p.turns))


def braid_grip(p, x, gauge_pa, t_s):
    """mu_k N P A_b of Eq. 5, in N per metre of braid lever (and per m/s)."""
    mu = p.mu_k * (1.0 + p.mu_slope_per_m * x) * math.exp(-p.mu_decay_per_s * t_s)
    mu *= 1.0 + p.mu_trend_per_s * t_s
    mu *= 1.0 + p.mu_per_pa * max(gauge_pa, 0.0)
    return mu * p.braids * p.contact_m2 * max(gauge_pa, 0.0)


def braid_lever(p, x):
    """b theta cos(theta): cos(theta) is L / b (below Eq. 1)."""
    length = p.rest_length_m - p.cap_m - x
    return length * math.acos(length / p.braid_m)


def nozzle(p, from_pa, to_pa, from_k):
    """Mass flow per area, kg/(s m2); against the arrow where the pressures say so."""
    if to_pa > from_pa:
        return -gas_jet(p, to_pa, from_pa, p.wall_k)
    return gas_jet(p, from_pa, to_pa, from_k)


def gas_jet(p, up_pa, down_pa, up_k):
    """Psi of Eq. 8: isentropic and choked below the critical ratio, or ISO 6358's ellipse."""
    g = p.heat_ratio
    ratio = down_pa / up_pa
    if p.critical_shift != 0.0:  # the unchoked branch is stretched
        begin = (2.0 / (g + 1.0)) ** (g / (g - 1.0))
        ratio = 1.0 - (1.0 - ratio) * (1.0 - begin) / (1.0 - begin - p.critical_shift)
    choked = (
        up_pa
        * math.sqrt(g / (p.gas_j_per_kg_k * up_k))
        * (2.0 / (g + 1.0)) ** ((g + 1.0) / (2.0 * (g - 1.0)))
    )
    if p.critical_ratio > 0.0:
        beyond = max(ratio - p.critical_ratio, 0.0) / (1.0 - p.critical_ratio)
        return choked * math.sqrt(1.0 - beyond * beyond)
    if ratio <= (2.0 / (g + 1.0)) ** (g / (g - 1.0)):
        return choked
    fall = ratio ** (2.0 / g) - ratio ** ((g + 1.0) / g)
    return up_pa * math.sqrt(max(fall, 0.0) * 2.0 * g / ((g - 1.0) * p.gas_j_per_kg_k * up_k))
