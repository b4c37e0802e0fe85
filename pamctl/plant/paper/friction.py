"""Forces along the muscle's axis (Eq. 4 and 5), friction as a band."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.paper.muscle import braid_lever_m, force_area_m2
from pamctl.plant.parameters import PaperParameters


class AxialForces(NamedTuple):
    """Forces at one position and pressure, and the friction that opposes motion.

    Friction is a two-sided band. At rest it takes any value in [lower, upper], and the muscle
    sticks while the drive lies inside. When moving up it is `upper` plus a viscous part, when
    moving down `lower` plus a viscous part.
    """

    drive_n: float
    lower_n: float
    upper_n: float
    damping_up_n_s_per_m: float
    damping_down_n_s_per_m: float
    rest_lower_n: float
    """The band in which the muscle sticks; it equals that of motion without the Stribeck effect."""
    rest_upper_n: float


def axial_forces(p: PaperParameters, position_m: float, pressure_pa: float) -> AxialForces:
    """Return the forces of Eq. 4 and 5 at (x, P).

    Eq. 5 does not define friction at zero velocity. It is taken as set-valued: any force in
    [0, mu_k N P_g A_b b theta cos(theta)]. Other choices chatter or creep. The paper's muscle has
    kinetic friction only when contracting, hence `lower` = 0. The printed numbers are in SI: they
    give 47 N at 340 kPa; in mm they would give 47 kN.
    """
    gauge_pa = pressure_pa - p.atmospheric_pressure_pa
    grip = p.friction_area_m * gauge_pa if gauge_pa > 0.0 else 0.0
    drive_n = gauge_pa * force_area_m2(p, position_m) - p.stiffness_n_per_m * position_m
    damping = p.damping_n_s_per_m
    kinetic_n = grip * braid_lever_m(p, position_m)
    return AxialForces(drive_n, 0.0, kinetic_n, damping + grip, damping, 0.0, kinetic_n)
