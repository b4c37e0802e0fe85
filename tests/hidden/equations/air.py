"""The paper's geometry and flow once more (Eqs. 1 to 3, 7, 8), behind a valve that is not ideal.

From the voltage that arrives at the driver to an opening; what flows where, and what pressure that
makes.
"""

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


def play(output, entered, width):
    """Follow `entered` with a slack of `width` in all."""
    return min(max(output, entered - 0.5 * width), entered + 0.5 * width)


def slewed(p, before, wanted, h):
    """Return how far the driver gets in h."""
    if p.slew_v_per_s == 0.0:
        return wanted
    return before + min(max(wanted - before, -p.slew_v_per_s * h), p.slew_v_per_s * h)


def spool(p, position, rate, drive, h):
    """One trapezoidal step of a mass on a spring that is driven to `drive` (all in volts)."""
    if p.spool_rad_per_s == 0.0:
        return drive, 0.0
    w = p.spool_rad_per_s * h
    drag = p.spool_damping * w + 0.25 * w * w
    new_rate = (rate * (1.0 - drag) + w * p.spool_rad_per_s * (drive - position)) / (1.0 + drag)
    return position + 0.5 * h * (rate + new_rate), new_rate


def uncovered(p, spool_v):
    """Return what the laps leave of the spool's travel, in volts."""
    if spool_v > p.overlap_fill_v:
        return spool_v - p.overlap_fill_v
    if spool_v < -p.overlap_vent_v:
        return spool_v + p.overlap_vent_v
    return 0.0


def opening(p, spool_v, t_s):
    """Return the port area: above 0 towards the supply, below 0 towards the atmosphere."""
    v = uncovered(p, spool_v)
    v *= 1.0 + p.curve_per_v * abs(v)
    if p.curve_exponent != 1.0:
        v = math.copysign(5.0 * (abs(v) / 5.0) ** p.curve_exponent, v)
    if v < 0.0:
        v *= p.vent_gain
    wobble = p.gain_wobble * math.sin(2.0 * math.pi * p.gain_wobble_hz * t_s)
    return p.valve_m2_per_v * v * (1.0 + wobble + p.gain_trend_per_s * t_s)


def null_leak(p, spool_v):
    """Return the area of each of the two leaks past the spool."""
    if p.null_leak_fade_per_v > 0.0:
        return p.null_leak_m2 / (1.0 + p.null_leak_fade_per_v * abs(spool_v))
    if p.null_leak_zone_v > 0.0 and abs(spool_v) > p.null_leak_zone_v:
        return 0.5 * p.null_leak_m2
    return p.null_leak_m2


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
