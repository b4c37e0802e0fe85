"""The paper's model written a second time, from the paper, for the tests to hold ours against.

Nothing here comes from `pamctl.plant`: Tables I and II in SI, Eq. 1 to 9 as they are read in
the README, and SciPy's general solvers. Friction is set-valued at rest, so the right-hand side
is discontinuous; it is split into three smooth ones (slip up, slip down, stick) with an event
at every change between them. That is exact: nothing is regularised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

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


class Recorded(NamedTuple):
    """The solution at the ticks, and what it went through on the way."""

    states: NDArray[np.float64]
    """A row a tick: x, v, P; row 0 is the start."""
    reversals: int
    """Times that motion began upwards after downwards, or the other way round."""
    stuck_s: float
    """Time at rest."""


def solve(
    commands: Sequence[float],
    period: float,
    *,
    method: str = "LSODA",
    rtol: float = 1e-10,
    source_pa: float = 1e-5,
) -> Recorded:
    """Integrate Eq. 9 from the vented muscle, one command a period.

    Near the source's pressure the flow goes with the square root of the difference, whose
    slope is infinite: within `source_pa` of it the pressure is held there. That is the one
    liberty taken; `source_pa` is 1e-5 Pa, and 1 Pa is worth some 0.1 um of motion.
    """
    state = [0.0, 0.0, P_ATM]
    mode = "stick"
    states = [tuple(state)]
    last_slip, reversals, stuck_s = "", 0, 0.0
    time, tick = 0.0, 0
    while tick < len(commands):
        # A command that is held is integrated in one piece.
        until = tick + 1
        while until < len(commands) and commands[until] == commands[tick]:
            until += 1
        grid = np.arange(tick + 1, until + 1) * period
        command = commands[tick]
        while True:
            begin = time
            time, state, seen, mode_after = _piece(
                command, mode, time, state, grid, method, rtol, source_pa
            )
            states += seen
            grid = grid[len(seen) :]
            if mode == "stick":
                stuck_s += time - begin
            if mode_after == mode and not len(grid):
                break
            if mode_after in ("up", "down"):
                reversals += last_slip not in ("", mode_after)
                last_slip = mode_after
            mode = mode_after
        tick = until
    return Recorded(np.array(states), reversals, stuck_s)


def _piece(
    command: float,
    mode: str,
    begin: float,
    state: list[float],
    grid: NDArray[np.float64],
    method: str,
    rtol: float,
    source_pa: float,
) -> tuple[float, list[float], list[tuple[float, ...]], str]:
    """Integrate one smooth piece: to the end of the grid, or to the event that ends the mode."""
    source = P_TANK if command > 0 else P_ATM

    def rates(t: float, y: NDArray[np.float64]) -> list[float]:
        x, v, pressure = y.tolist()
        if command and abs(pressure - source) < source_pa:
            pressure_slope = (source - pressure) * 1e3  # held, by a lag of 1 ms
        else:
            pressure_slope = pressure_rate(command, x, v if mode != "stick" else 0.0, pressure)
        if mode == "stick":
            return [0.0, 0.0, pressure_slope]
        if mode == "up":
            friction = kinetic_friction(x, pressure) + (C + grip(pressure)) * v
        else:
            friction = C * v
        return [v, (drive(x, pressure) - friction) / M, pressure_slope]

    def stops(t: float, y: NDArray[np.float64]) -> float:
        return float(y[1])

    def breaks_up(t: float, y: NDArray[np.float64]) -> float:
        return drive(y[0], y[2]) - kinetic_friction(y[0], y[2])

    def breaks_down(t: float, y: NDArray[np.float64]) -> float:
        return drive(y[0], y[2])

    events: list[Any] = [breaks_up, breaks_down] if mode == "stick" else [stops]
    for event in events:
        event.terminal = True
        event.direction = 1 if event is breaks_up or (mode == "down") else -1

    solution = solve_ivp(
        rates,
        (begin, grid[-1]),
        state,
        method=method,
        rtol=rtol,
        atol=[1e-3 * rtol, rtol, 1e5 * rtol],
        t_eval=grid,
        events=events,
        first_step=min(1e-7, grid[-1] - begin),
    )
    assert solution.success, solution.message
    seen = list(zip(*solution.y, strict=True))  # empty where the event came before the next tick
    if solution.status == 0:
        return grid[-1], list(seen[-1]), seen, mode
    which = next(i for i, hits in enumerate(solution.t_events) if len(hits))
    time = float(solution.t_events[which][0])
    x, _, pressure = solution.y_events[which][0].tolist()
    return time, [x, 0.0, pressure], seen, _mode_after(mode, events[which], x, pressure)


def _mode_after(mode: str, event: Callable[..., float], x: float, pressure: float) -> str:
    if mode == "stick":
        return "up" if event.__name__ == "breaks_up" else "down"
    if drive(x, pressure) < 0.0:
        return "down"
    return "up" if drive(x, pressure) > kinetic_friction(x, pressure) else "stick"
