"""A cylinder or a muscle behind a valve, by the equations of a textbook and LSODA.

    M x'' = A (P - P_a) - F_0 - k x - c x' - F_c sign(x') + ends
    V P' = n (R T m - P A x'),   m = K (|u| - dead band) Psi - leak,   A = dV/dx

It shares no code with pamctl. Ends are stiff springs that absorb speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from pamctl.plant.model import PlantSettings

Array = NDArray[np.float64]

AIR_PA = 101.3e3
RT = 287.1 * 293.0
GAMMA = 1.4
CRITICAL = (2.0 / (GAMMA + 1.0)) ** (GAMMA / (GAMMA - 1.0))
END_N_PER_M, END_N_S_PER_M = 2e6, 4e3


def excite(t_s: Array) -> Array:
    """Return commands that move a piston slowly and fast, V."""
    slow, fast = np.sin(2 * np.pi * 0.6 * t_s), np.sin(2 * np.pi * 2.3 * t_s + 0.4)
    return np.asarray(2.5 * slow + 1.2 * fast * (t_s > 1.0))


def psi(up_pa: float, down_pa: float) -> float:
    """Return the isentropic flow per area, kg/(s m^2)."""
    r = max(down_pa / up_pa, CRITICAL)
    grows = 2.0 * GAMMA / ((GAMMA - 1.0) * RT)
    return up_pa * float(
        np.sqrt(max(0.0, grows * (r ** (2.0 / GAMMA) - r ** ((GAMMA + 1.0) / GAMMA))))
    )


@dataclass(frozen=True)
class Cylinder:
    """The numbers of the rig; the last are what a plain plant file lacks."""

    area_m2: float = 4.9e-4
    volume_m3: float = 3e-5
    stroke_m: float = 0.1
    mass_kg: float = 1.2
    damping_n_s_per_m: float = 80.0
    stiffness_n_per_m: float = 1500.0
    preload_n: float = 30.0
    supply_pa: float = 7e5
    gain_m2_per_v: float = 3e-7
    coulomb_n: float = 0.0
    dead_band_v: float = 0.0
    leak_m2: float = 0.0
    exponent: float = 1.0
    """n of the air: 1 where it keeps its temperature, 1.4 where it exchanges no heat."""
    bumper_m: float = 1.0
    bumper_n_per_m: float = 0.0
    """Where a piece of rubber is touched, and its stiffness."""

    def plant(self) -> PlantSettings:
        """Return the plant file of these numbers, without what it lacks."""
        return PlantSettings.model_validate(
            {
                "actuator": "cylinder",
                "cylinder_area_m2": self.area_m2,
                "cylinder_volume_m3": self.volume_m3,
                "stroke_m": self.stroke_m,
                "parameters": {
                    "mass_kg": self.mass_kg,
                    "damping_n_s_per_m": self.damping_n_s_per_m,
                    "stiffness_n_per_m": self.stiffness_n_per_m,
                    "tank_pressure_pa": self.supply_pa,
                    "atmospheric_pressure_pa": AIR_PA,
                    "valve_gain_m2_per_v": self.gain_m2_per_v,
                },
                "effects": {"external_load": {"force_n": self.preload_n}},
            }
        )

    def area(self, x: float) -> float:
        """Return the area that the pressure pushes, m^2."""
        return self.area_m2

    def volume(self, x: float) -> float:
        """Return the volume of the air, m^3."""
        return self.volume_m3 + self.area_m2 * x

    def flow_kg_per_s(self, command_v: float, pressure_pa: float) -> float:
        """Return the mass flow into the cylinder."""
        opening = max(abs(command_v) - self.dead_band_v, 0.0) * self.gain_m2_per_v
        source_pa = self.supply_pa if command_v > 0.0 else AIR_PA
        if source_pa >= pressure_pa:
            flow = opening * psi(source_pa, pressure_pa)
        else:
            flow = -opening * psi(pressure_pa, source_pa)
        return flow - self.leak_m2 * psi(max(pressure_pa, AIR_PA), AIR_PA)

    def simulate(self, t_s: Array, commands_v: Array) -> tuple[Array, Array]:
        """Return position (m) and absolute pressure (Pa) at the samples, from rest."""

        def rates(_: float, y: Array, command_v: float) -> list[float]:
            x, v, pressure = y
            area = self.area(x)
            force = area * (pressure - AIR_PA) - self.preload_n
            force -= self.stiffness_n_per_m * x + self.damping_n_s_per_m * v
            force -= self.coulomb_n * np.tanh(v / 2e-4)
            force -= self.bumper_n_per_m * max(x - self.bumper_m, 0.0)
            if x <= 0.0:
                force += -END_N_PER_M * x - END_N_S_PER_M * min(v, 0.0)
            if x >= self.stroke_m:
                force -= END_N_PER_M * (x - self.stroke_m) + END_N_S_PER_M * max(v, 0.0)
            grows = RT * self.flow_kg_per_s(command_v, pressure) - pressure * area * v
            grows *= self.exponent / self.volume(x)
            return [v, force / self.mass_kg, grows]

        state = np.array([0.0, 0.0, AIR_PA])
        rows = [state]
        period = float(t_s[1] - t_s[0])
        for command in commands_v[:-1]:
            found = solve_ivp(
                rates, (0.0, period), state, "LSODA", args=(command,), rtol=1e-7,
                atol=[1e-9, 1e-7, 1e-1],
            )  # fmt: skip
            state = found.y[:, -1]
            rows.append(state)
        table = np.array(rows)
        return table[:, 0], table[:, 2]


@dataclass(frozen=True)
class LiftingMuscle(Cylinder):
    """A muscle, Eq. 1 to 3 without friction, that lifts a mass off a floor; it has no spring."""

    stroke_m: float = 0.06
    mass_kg: float = 12.0
    damping_n_s_per_m: float = 350.0
    stiffness_n_per_m: float = 0.0
    preload_n: float = 117.7
    gain_m2_per_v: float = 2e-7
    rest_m: float = 0.2
    braid_m: float = 0.232
    turns: float = 1.94

    def area(self, x: float) -> float:
        """Return the force per gauge pressure of Eq. 3, m^2."""
        return (3.0 * (self.rest_m - x) ** 2 - self.braid_m**2) / (4.0 * np.pi * self.turns**2)

    def volume(self, x: float) -> float:
        """Return Eq. 1 and 2, m^3."""
        length = self.rest_m - x
        return length * (self.braid_m**2 - length**2) / (4.0 * np.pi * self.turns**2)

    def plant(self) -> PlantSettings:
        """Return the plant file of these numbers, without what it lacks."""
        data = super().plant().model_dump(exclude_none=True)
        own = {"rest_length_m": self.rest_m, "braid_length_m": self.braid_m}
        numbers = data["parameters"] | own | {"braid_turns": self.turns}
        return PlantSettings.model_validate(
            {
                "stroke_m": self.stroke_m,
                "parameters": numbers | {"kinetic_friction_per_m": 0.0, "temperature_k": 293.0},
                "effects": data["effects"],
            }
        )
