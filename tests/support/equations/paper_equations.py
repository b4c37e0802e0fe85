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
    """A row a tick: x, v, P, opening of the valve, its rate; row 0 is the start."""
    reversals: int
    """Times that motion began upwards after downwards, or the other way round."""
    stuck_s: float
    """Time at rest."""


class Spool(NamedTuple):
    """A valve that follows its command as a system of second order."""

    natural_rad_per_s: float
    damping_ratio: float


def solve(
    commands: Sequence[float],
    period: float,
    *,
    spool: Spool | None = None,
    method: str = "LSODA",
    rtol: float = 1e-10,
) -> Recorded:
    """Integrate Eq. 9 from the vented muscle, one command a period."""
    state = [0.0, 0.0, P_ATM, 0.0, 0.0]
    mode, last_slip = "stick", ""
    states = [tuple(state)]
    reversals, stuck_s, time, tick = 0, 0.0, 0.0, 0
    while tick < len(commands):
        # A command that is held is integrated in one piece.
        until = tick + 1
        while until < len(commands) and commands[until] == commands[tick]:
            until += 1
        grid = np.arange(tick + 1, until + 1) * period
        if spool is None:
            state[3] = commands[tick]
        while len(grid):
            piece = _Piece(mode, commands[tick], spool)
            begin = time
            time, state, seen, mode_after = piece.run(time, state, grid, method, rtol)
            states += seen
            grid = grid[len(seen) :]
            stuck_s += time - begin if mode == "stick" else 0.0
            if mode_after != mode and mode_after != "stick":
                reversals += last_slip not in ("", mode_after)
                last_slip = mode_after
            mode = mode_after
        tick = until
    return Recorded(np.array(states), reversals, stuck_s)


SOURCE_PA = 1e-5
"""Near the source's pressure the flow goes with the square root of the difference, whose slope is
infinite. Within this of it the pressure is led to it by a lag of 1 ms: the one liberty taken.
1 Pa is worth 0.1 um of motion, so this is worth 1e-6 um."""

HAIR = 1e-9
"""N beyond friction at which motion begins: the vented muscle lies exactly on both bounds."""


class _Piece:
    """Eq. 9 while friction is smooth: slip up, slip down, or stick."""

    def __init__(self, mode: str, command: float, spool: Spool | None) -> None:
        self.mode = mode
        self.command = command
        self.spool = spool
        if mode == "stick":
            self.events = [self.breaks_up, self.breaks_down]
        else:
            self.events = [self.stops]

    def rates(self, t: float, y: NDArray[np.float64]) -> list[float]:
        x, v, pressure, opening, opening_rate = y.tolist()
        source = P_TANK if opening > 0 else P_ATM
        pressure_slope = pressure_rate(opening, x, v, pressure)
        if opening and abs(pressure - source) < SOURCE_PA:
            pressure_slope = (source - pressure) * 1e3
        force = 0.0
        if self.mode == "up":
            force = drive(x, pressure) - kinetic_friction(x, pressure) - (C + grip(pressure)) * v
        elif self.mode == "down":
            force = drive(x, pressure) - C * v
        jerk = 0.0
        if self.spool is not None:
            natural, damping = self.spool
            jerk = natural**2 * (self.command - opening) - 2 * damping * natural * opening_rate
        return [v, force / M, pressure_slope, opening_rate, jerk]

    def stops(self, t: float, y: NDArray[np.float64]) -> float:
        return -float(y[1]) if self.mode == "up" else float(y[1])

    def breaks_up(self, t: float, y: NDArray[np.float64]) -> float:
        return drive(y[0], y[2]) - kinetic_friction(y[0], y[2]) - HAIR

    def breaks_down(self, t: float, y: NDArray[np.float64]) -> float:
        return -drive(y[0], y[2]) - HAIR

    def run(
        self, begin: float, state: list[float], grid: NDArray[np.float64], method: str, rtol: float
    ) -> tuple[float, list[float], list[tuple[float, ...]], str]:
        """Go to the end of the grid, or to the event that ends the mode.

        Returns the time and state there, the states on the grid, and the mode that follows.
        """
        solution = solve_ivp(
            self.rates,
            (begin, grid[-1]),
            state,
            method=method,
            rtol=rtol,
            atol=rtol * np.array([1e-3, 1.0, 1e5, 1.0, 1e3]),
            t_eval=grid,
            events=[_terminal(event) for event in self.events],
            first_step=min(1e-7, grid[-1] - begin),
        )
        assert solution.success, solution.message
        seen = list(zip(*solution.y, strict=True))  # empty if the event came before the next tick
        if solution.status == 0:
            return grid[-1], list(seen[-1]), seen, self.mode
        which = next(i for i, times in enumerate(solution.t_events) if len(times))
        x, _, pressure, *valve = solution.y_events[which][0].tolist()
        after = self.mode_after(which, x, pressure)
        return float(solution.t_events[which][0]), [x, 0.0, pressure, *valve], seen, after

    def mode_after(self, which: int, x: float, pressure: float) -> str:
        if self.mode == "stick":
            return ("up", "down")[which]
        if drive(x, pressure) < 0.0:
            return "down"
        return "up" if drive(x, pressure) > kinetic_friction(x, pressure) else "stick"


def _terminal(event: Callable[[float, NDArray[np.float64]], float]) -> Any:
    """Every event here ends its piece, and is one of a value that rises through zero."""

    def terminal(t: float, y: NDArray[np.float64]) -> float:
        return event(t, y)

    terminal.terminal = True  # type: ignore[attr-defined]
    terminal.direction = 1  # type: ignore[attr-defined]
    return terminal
