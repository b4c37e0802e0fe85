"""The paper's equations written a second time, from the paper, for the tests to hold ours against.

Nothing here comes from `pamctl.plant`: Tables I and II in SI, Eq. 1 to 8 as they are read in the
README. A third reading, which moves, is in `hidden.equations`.
"""

from __future__ import annotations

import math

# Table I
M = 0.05
C = 0.57e3
TURNS = 1.94
MU_K = 55.3
BRAIDS = 100
L_0 = 0.200
B = 0.232
K = 9.68e3
A_B = 0.233e-6
# Table II
P_TANK = 441.3e3
P_ATM = 101.3e3
R = 287.1
T = 273.0
K_AV = 1.03e-6
GAMMA = 1.4  # air; the paper does not print it

CRITICAL_RATIO = (2 / (GAMMA + 1)) ** (GAMMA / (GAMMA - 1))


def volume(x: float) -> float:
    """Eq. 1 and 2."""
    length = L_0 - x
    return length * (B**2 - length**2) / (4 * math.pi * TURNS**2)


def area(x: float) -> float:
    """-dV/dL, the force per gauge pressure of Eq. 3."""
    return (3 * (L_0 - x) ** 2 - B**2) / (4 * math.pi * TURNS**2)


def drive(x: float, pressure: float) -> float:
    """What pulls against friction and inertia in Eq. 4."""
    return (pressure - P_ATM) * area(x) - K * x


def grip(pressure: float) -> float:
    """mu_k N P A_b of Eq. 5."""
    return MU_K * BRAIDS * max(0.0, pressure - P_ATM) * A_B


def kinetic_friction(x: float, pressure: float) -> float:
    """The part of Eq. 5 that does not depend on speed: mu_k N P A_b b theta cos(theta)."""
    theta = math.acos((L_0 - x) / B)
    return grip(pressure) * B * theta * math.cos(theta)


def psi(upstream: float, downstream: float) -> float:
    """Isentropic flow through an orifice, per area, kg/(s m^2); choked below the critical ratio."""
    ratio = downstream / upstream
    if ratio <= CRITICAL_RATIO:
        throat = (2 / (GAMMA + 1)) ** ((GAMMA + 1) / (2 * (GAMMA - 1)))
        return upstream * math.sqrt(GAMMA / (R * T)) * throat
    expansion = ratio ** (2 / GAMMA) - ratio ** ((GAMMA + 1) / GAMMA)
    return upstream * math.sqrt(2 * GAMMA / ((GAMMA - 1) * R * T) * max(0.0, expansion))


def inflow(command: float, pressure: float) -> float:
    """Mass flow of Eq. 8: from the tank where the command is positive, else the atmosphere."""
    source = P_TANK if command > 0 else P_ATM
    if pressure <= source:
        return K_AV * abs(command) * psi(source, pressure)
    return -K_AV * abs(command) * psi(pressure, source)


def pressure_rate(command: float, x: float, v: float, pressure: float) -> float:
    """Eq. 7, V' = A(x) v."""
    return (R * T * inflow(command, pressure) - pressure * area(x) * v) / volume(x)
