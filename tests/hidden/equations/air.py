"""The air: what flows where, and what pressure that makes (Eqs. 7 and 8)."""

from __future__ import annotations

import math

from hidden.equations.physics import nozzle, volume
from hidden.equations.valve import null_leak


def valve_flows(p, area, leak, tank_pa, port_pa, gas_k):
    """Return the mass flow out of the supply and the one into the atmosphere, kg/s."""
    taken = (max(area, 0.0) + leak) * nozzle(p, tank_pa, port_pa, p.wall_k)
    given = (max(-area, 0.0) + leak) * nozzle(p, port_pa, p.atmosphere_pa, gas_k)
    return taken, given


def supply_pa(p, t_s):
    """Return what the regulator holds."""
    held = p.supply_pa + p.ripple_pa * math.sin(2.0 * math.pi * p.ripple_hz * t_s + p.ripple_rad)
    if p.saw_pa != 0.0:
        turns = t_s / p.saw_s
        held += p.saw_pa * (0.5 - (turns - math.floor(turns)))
    return held


def tank_after(p, tank_pa, taken, t_s, h):
    """Return the tank's pressure after h: emptied by the valve, refilled by the regulator."""
    if p.regulator_pa_s_per_kg == 0.0:
        return supply_pa(p, t_s + h)
    resistance = p.regulator_pa_s_per_kg * (1.0 - p.fast_tank_share)
    full = supply_pa(p, t_s) - resistance * taken
    return full + (tank_pa - full) * math.exp(-h / refill_s(p))


def refill_s(p):
    """Return the time in which the regulator fills the tank."""
    return p.tank_m3 * p.regulator_pa_s_per_kg / (p.gas_j_per_kg_k * p.wall_k)


def fast_tank_after(p, fast_pa, taken, h):
    """Return by how much the second tank is below the first after h."""
    if p.fast_tank_share == 0.0:
        return 0.0
    empty = p.fast_tank_share * p.regulator_pa_s_per_kg * taken
    return empty + (fast_pa - empty) * math.exp(-h / (0.1 * refill_s(p)))


def pressure_of(p, air, gas_k, x, guess_pa):
    """Return the pressure of the air in the muscle; `guess_pa` starts a braid that stretches."""
    pressure = guess_pa
    for _ in range(1 if p.stretch_per_pa == 0.0 and p.hose_m3_per_pa == 0.0 else 6):
        room = volume(p, x, pressure - p.atmosphere_pa)
        if p.wall_heat_w_per_k > 0.0:
            pressure = air * gas_k / room
        elif p.polytropic == 1.0:
            pressure = air / room
        else:
            pressure = air / room**p.polytropic
    return pressure


def air_of(p, pressure_pa, x):
    """Return the air of a muscle that has been at rest for long."""
    room = volume(p, x, pressure_pa - p.atmosphere_pa)
    if p.wall_heat_w_per_k > 0.0:
        return pressure_pa * room / p.wall_k
    return pressure_pa * room**p.polytropic


def air_after(p, air, flow, pressure_pa, x, h):
    """Let `flow` (kg/s) enter for h, at a pressure and position from the middle of h."""
    if p.wall_heat_w_per_k > 0.0:
        return air + h * p.gas_j_per_kg_k * flow
    brought = h * p.gas_j_per_kg_k * p.wall_k * flow
    if p.polytropic == 1.0:
        return air + brought
    room = volume(p, x, pressure_pa - p.atmosphere_pa)
    return air + brought * p.polytropic * room ** (p.polytropic - 1.0)


def gas_after(p, air, gas_k, flow, expansion_w, h):
    """Return the gas temperature after h: enthalpy in and out, work done, heat through the wall."""
    if p.wall_heat_w_per_k == 0.0:
        return p.wall_k
    cv = 1.0 / (p.heat_ratio - 1.0)
    entering_k = p.wall_k if flow > 0.0 else gas_k
    power = p.gas_j_per_kg_k * flow * (p.heat_ratio * cv * entering_k - cv * gas_k)
    power += p.wall_heat_w_per_k * (p.wall_k - gas_k) - expansion_w
    return gas_k + h * power / (air * cv)


def flows(p, area, spool_v, tank_pa, port_pa, muscle_pa, gas_k):
    """Return (taken from the supply, entering at the port, lost by the chamber), kg/s."""
    taken, given = valve_flows(p, area, null_leak(p, spool_v), tank_pa, port_pa, gas_k)
    lost = 0.0
    if p.chamber_leak_m2 > 0.0:
        lost = p.chamber_leak_m2 * nozzle(p, muscle_pa, p.atmosphere_pa, gas_k)
    return taken, taken - given, lost
