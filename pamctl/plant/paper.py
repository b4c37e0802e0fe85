"""The paper's model as printed: Tables I and II, and Eq. 1 to 9.

Two blocks: the pressure (u, x -> P) and the mechanics (P -> x). Pressures are absolute, units SI.
"""

from __future__ import annotations

import math
from math import acos, exp, log, pow, sqrt
from typing import Annotated, NamedTuple

from pydantic import Field, model_validator

from hal.calibration import Configured

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

    mass_kg: Annotated[float, Field(ge=1e-9, le=1e6, description="moving mass, M")] = 0.05
    damping_n_s_per_m: Annotated[
        float,
        Field(ge=0, le=1e12, description="damping, force per speed, c; a guess will do"),
    ] = 570.0
    stiffness_n_per_m: Annotated[
        float,
        Field(ge=0, le=1e12, description="stiffness of the spring, k; a guess will do"),
    ] = 9680.0
    rest_length_m: Annotated[
        float,
        Field(
            ge=1e-4, le=LONGEST_M, description="length of the vented muscle between its ends, L_0"
        ),
    ] = 0.200
    braid_length_m: Annotated[
        float, Field(ge=1e-4, le=LONGEST_M, description="length of one braid thread, b")
    ] = 0.232
    braid_turns: Annotated[
        float,
        Field(ge=1e-3, le=1e6, description="turns of one braid thread around the muscle, n"),
    ] = 1.94
    kinetic_friction_per_m: Annotated[
        float, Field(ge=0, le=1e12, description="friction of the braid, mu_k; a guess will do")
    ] = 55.3
    braid_count: Annotated[float, Field(ge=0, le=1e6, description="number of braid threads, N")] = (
        100.0
    )
    braid_contact_area_m2: Annotated[
        float, Field(ge=0, le=1, description="contact area of two braid threads, A_b")
    ] = 0.233e-6
    tank_pressure_pa: Annotated[
        float, Field(ge=1, le=HIGHEST_TANK_PA, description="pressure of the supply, absolute")
    ] = 441.3e3
    atmospheric_pressure_pa: Annotated[
        float,
        Field(
            ge=1,
            le=HIGHEST_ATMOSPHERE_PA,
            description="pressure of the air in the laboratory, absolute: read a barometer; behind "
            "a valve 1 % of it moves forces and masses by 1 %",
        ),
    ] = 101.3e3
    gas_constant_j_per_kg_k: Annotated[
        float, Field(ge=1, le=1e6, description="gas constant of the air")
    ] = 287.1
    temperature_k: Annotated[
        float,
        Field(
            ge=1,
            le=HOTTEST_K,
            description="temperature of the air; of `actuator: chamber` 293 by default",
        ),
    ] = 273.0
    heat_capacity_ratio: Annotated[float, Field(gt=1, le=2, description="gamma of Psi")] = 1.4
    valve_gain_m2_per_v: Annotated[
        float, Field(ge=1e-15, le=1, description="opening of the valve per volt of command, K_Av")
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
    cylinder_area_m2: float = 0.0
    """Area of a piston; a muscle has none, and a cylinder or chamber no braid (volume_scale 0)."""
    cylinder_volume_m3: float = 0.0
    """Volume behind the piston at position 0, or of a chamber."""


def volume_m3(p: PaperParameters, position_m: float) -> float:
    """Return the volume V(x) of Eq. 2, with L = L_0 - x (Eq. 1); of a cylinder V_0 + A x."""
    length = p.rest_length_m - position_m
    braid = length * (p.braid_length_m * p.braid_length_m - length * length) * p.volume_scale
    return braid + (p.cylinder_volume_m3 + p.cylinder_area_m2 * position_m)


def force_area_m2(p: PaperParameters, position_m: float) -> float:
    """Return A(x) = (3 L^2 - b^2) / (4 pi n^2): force per gauge pressure (Eq. 3), and dV/dx.

    The paper writes P. It is taken as gauge pressure: with absolute pressure the vented muscle
    would rest at 11.6 mm, and could not reach the set point of 6.4 mm.
    """
    length = p.rest_length_m - position_m
    braid = (3.0 * length * length - p.braid_length_m * p.braid_length_m) * p.volume_scale
    return braid + p.cylinder_area_m2


def braid_lever_m(p: PaperParameters, position_m: float) -> float:
    """Return b theta cos(theta) of Eq. 5, where cos(theta) = L / b: L arccos(L / b)."""
    length = p.rest_length_m - position_m
    return length * acos(length / p.braid_length_m)


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


def middle_pressure_pa(
    p: PaperParameters,
    pressure_pa: float,
    opening_v: float,
    position_m: float,
    middle_m: float,
    step_s: float,
) -> float:
    """Predict the absolute pressure in the middle of the step."""
    energy = pressure_pa * volume_m3(p, position_m)
    inflow = valve_flow(p, opening_v, pressure_pa)
    filled = energy + 0.5 * step_s * p.specific_energy_j_per_kg * inflow
    return _stop_at_source(p, opening_v, pressure_pa, filled / volume_m3(p, middle_m))


def pressure_step(
    p: PaperParameters,
    pressure_pa: float,
    middle_pa: float,
    opening_v: float,
    position_m: float,
    end_m: float,
    step_s: float,
) -> float:
    """Advance the absolute pressure of Eq. 7 and 8 by one midpoint step.

    `opening_v` is the valve's opening in the middle of the step, in volts of command.
    """
    if opening_v != 0.0:
        source_pa = p.tank_pressure_pa if opening_v > 0.0 else p.atmospheric_pressure_pa
        if middle_pa == source_pa:
            # The prediction reached the end within half a step of the first flow. The flow goes
            # as the root of the difference: the true time is twice that, and ends in this step.
            return middle_pa
    energy = pressure_pa * volume_m3(p, position_m)
    inflow = valve_flow(p, opening_v, middle_pa)
    filled = energy + step_s * p.specific_energy_j_per_kg * inflow
    return _stop_at_source(p, opening_v, middle_pa, filled / volume_m3(p, end_m))


def _stop_at_source(
    p: PaperParameters, opening_v: float, pressure_pa: float, next_pa: float
) -> float:
    """Stop at the source's pressure.

    The flow goes as the square root of the pressure difference, and reaches zero in finite time.
    An explicit step would overshoot and chatter by some 30 Pa.
    """
    if opening_v == 0.0:
        return next_pa
    source_pa = p.tank_pressure_pa if opening_v > 0.0 else p.atmospheric_pressure_pa
    if (pressure_pa - source_pa) * (next_pa - source_pa) < 0.0:
        return source_pa
    return next_pa


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


def mechanics_step(
    p: PaperParameters,
    position_m: float,
    velocity_m_per_s: float,
    middle_pressure_pa: float,
    step_s: float,
) -> tuple[float, float]:
    """Advance (x, v) of Eq. 6 by one exponential midpoint step.

    `middle_pressure_pa` is the absolute pressure in the middle of the step.
    """
    middle_m = position_m + 0.5 * step_s * velocity_m_per_s
    forces = axial_forces(p, middle_m, middle_pressure_pa)
    return slide(forces, p.mass_kg, position_m, velocity_m_per_s, step_s)


def slide(
    forces: AxialForces, mass_kg: float, position_m: float, velocity_m_per_s: float, step_s: float
) -> tuple[float, float]:
    """Move exactly under constant forces, also through a stop and a reversal.

    Returns position (m) and velocity (m/s) after `step_s`.
    """
    if velocity_m_per_s == 0.0:
        return leave_rest(forces, mass_kg, position_m, step_s)
    if velocity_m_per_s > 0.0:
        damping = forces.damping_up_n_s_per_m
        terminal = (forces.drive_n - forces.upper_n) / damping
    else:
        damping = forces.damping_down_n_s_per_m
        terminal = (forces.drive_n - forces.lower_n) / damping
    rate = damping / mass_kg
    excess = velocity_m_per_s - terminal
    decay = exp(-rate * step_s)
    velocity = terminal + excess * decay
    # Compare signs: the product would underflow at the end of a decaying motion.
    if velocity != 0.0 and (velocity > 0.0) == (velocity_m_per_s > 0.0):
        return position_m + terminal * step_s + excess * (1.0 - decay) / rate, velocity
    # It comes to rest within the step; then friction decides whether it sticks.
    stop_s = min(log(excess / -terminal) / rate, step_s) if terminal != 0.0 else step_s
    rest_m = position_m + terminal * stop_s + velocity_m_per_s / rate
    return leave_rest(forces, mass_kg, rest_m, step_s - stop_s)


def leave_rest(
    forces: AxialForces, mass_kg: float, position_m: float, step_s: float
) -> tuple[float, float]:
    """Stick while the drive lies in the friction band, else accelerate out of it."""
    if forces.rest_lower_n <= forces.drive_n <= forces.rest_upper_n:
        return position_m, 0.0
    if forces.drive_n > forces.upper_n:
        damping = forces.damping_up_n_s_per_m
        terminal = (forces.drive_n - forces.upper_n) / damping
    else:
        damping = forces.damping_down_n_s_per_m
        terminal = (forces.drive_n - forces.lower_n) / damping
    rate = damping / mass_kg
    growth = 1.0 - exp(-rate * step_s)
    return position_m + terminal * (step_s - growth / rate), terminal * growth
