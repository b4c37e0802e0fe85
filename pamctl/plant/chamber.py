"""The pressure block with effects: leaks, supply, line, volumes, thermodynamics.

It uses the midpoint step of `pressure_step`, and at neutral values gives the same bits. The stiff
parts are solved implicitly: the supply behind its regulator and the air in the line follow their
lags exactly, with the flow at the middle of the step. Their time constants may be arbitrarily
short.
"""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.catalogue import add_flow, pass_volume
from pamctl.plant.effects.air import (
    COLDEST,
    HOTTEST,
    HeatShares,
    droop_resistance,
    heat_shares,
    kept_of_branch,
    kept_share,
    line_drop_pa,
    line_time_s,
    nozzle_ratio,
    outflow_energy,
    polytropic_slope,
    polytropic_volume,
    resistance_at_drop,
    restricts,
    ripple_pa,
)
from pamctl.plant.effects.mechanics import stretch_ratio
from pamctl.plant.effects.places import lag_weights
from pamctl.plant.effects.valve import leak_area_m2
from pamctl.plant.paper import orifice_flow, volume_m3
from pamctl.plant.parameters import AirState, PlantParameters
from pamctl.plant.terms import (
    FLOW_AT,
    LEAK_AT,
    NO_MEMORY,
    SUPPLY_AT,
    VOLUME_AT,
    TermDrivers,
    push_of,
)

LEAST_SHARE = 0.05
"""A term takes no more of the volume than this leaves."""
LOWEST_SUPPLY_PA = 1e3
SOLVED_PA = 1e-3
"""Tolerance of a pressure that is found by iteration."""


class AirBegin(NamedTuple):
    """What the air's part of a step begins with."""

    pressure_pa: float
    """Absolute pressure in the muscle."""
    air: AirState
    opening_v: float
    position_m: float
    middle_m: float
    """Position that is expected in the middle of the step."""
    age_s: float
    step_s: float


class AirNow(NamedTuple):
    """What acts on the air over one step."""

    extra_kg_per_s: float
    """Extra flow into the muscle, from effects and terms."""
    tank_pa: float
    """Absolute pressure of the supply, before it droops."""
    tank_m2: float
    """Open area to the supply."""
    atmosphere_m2: float
    """Open area to the room."""
    leak_m2: float
    """Area of a leak from the muscle into the room, past the valve."""
    air: AirState
    """At the begin of the step."""


class MuscleFeed(NamedTuple):
    """Supply, node and flow in the middle of a step."""

    supply_pa: float
    """Pressure upstream of the valve."""
    node_pa: float
    """Pressure downstream of the valve: at the line's valve end, or in the muscle."""
    inflow_kg_per_s: float
    """Flow through the valve into the node."""


def find_air_now(
    p: PlantParameters, begin: AirBegin, pressure_pa: float, position_m: float, age_s: float
) -> AirNow:
    """Return what acts on the air, with the extra flow at a point of the step."""
    opening_v, effects = begin.opening_v, p.effects.air
    extra = add_flow(effects, 0.0, opening_v, pressure_pa, position_m, age_s)
    tank_pa = p.paper.tank_pressure_pa + ripple_pa(effects.supply_ripple, age_s)
    tank_pa = max(tank_pa, LOWEST_SUPPLY_PA)
    out_m2: float = effects.chamber_leak.area_m2
    if p.terms is not None:
        gauge_pa = pressure_pa - p.paper.atmospheric_pressure_pa
        now = TermDrivers(opening_v, position_m, gauge_pa, 0.0, age_s)
        extra += push_of(p.terms.air, FLOW_AT, NO_MEMORY, now)
        tank_pa = max(tank_pa + push_of(p.terms.air, SUPPLY_AT, NO_MEMORY, now), LOWEST_SUPPLY_PA)
        out_m2 = max(out_m2 + push_of(p.terms.air, LEAK_AT, NO_MEMORY, now), 0.0)
    area = p.paper.valve_gain_m2_per_v * abs(opening_v)
    leak = leak_area_m2(effects.valve_leak, opening_v)
    if opening_v > 0.0:
        return AirNow(extra, tank_pa, area + leak, leak, out_m2, begin.air)
    return AirNow(extra, tank_pa, leak, area + leak, out_m2, begin.air)


def port_flow(p: PlantParameters, source_pa: float, pressure_pa: float) -> float:
    """Return the mass flow per area from a source, kg/(s m^2); negative if the source is lower."""
    upstream, downstream, sign = source_pa, pressure_pa, 1.0
    if source_pa < pressure_pa:
        upstream, downstream, sign = pressure_pa, source_pa, -1.0
    if p.effects.air.discharge_ratio.shift != 0.0:
        ratio = downstream / upstream
        downstream = upstream * nozzle_ratio(
            p.effects.air.discharge_ratio, ratio, p.paper.critical_ratio
        )
    return sign * orifice_flow(p.paper, upstream, downstream)


def flow_through_ports(p: PlantParameters, now: AirNow, supply_pa: float, node_pa: float) -> float:
    """Return the mass flow into the node, kg/s."""
    flow = 0.0
    if now.tank_m2 > 0.0:
        flow = now.tank_m2 * port_flow(p, supply_pa, node_pa)
    if now.atmosphere_m2 > 0.0:
        flow += now.atmosphere_m2 * port_flow(p, p.paper.atmospheric_pressure_pa, node_pa)
    return flow


def false_position(one: float, miss_one: float, other: float, miss_other: float) -> float:
    """Return the zero of the line through two points (false position)."""
    return (one * miss_other - other * miss_one) / (miss_other - miss_one)


def keep_bracket_end(
    one: float, miss_one: float, other: float, miss_other: float, miss: float
) -> tuple[float, float]:
    """Return the bracket's end on the other side of the root from a new point with residual `miss`.

    The residual of an end that stays is halved (Illinois method), so that both ends move.
    """
    if (miss > 0.0) == (miss_other > 0.0):
        return one, 0.5 * miss_one
    return other, miss_other


def rest_supply_pa(p: PlantParameters, now: AirNow, step_s: float) -> float:
    """Return the pressure upstream of the valve after `step_s` without flow."""
    droop = p.effects.air.supply_droop
    if droop.resistance_pa_s_per_kg <= 0.0:
        return now.tank_pa
    kept = kept_share(droop, step_s)
    idle_pa: float = kept * now.air.supply_pa + (1.0 - kept) * now.tank_pa
    if droop.fast_share > 0.0:
        idle_pa -= kept_of_branch(droop, step_s) * now.air.branch_pa
    return idle_pa


def solve_supply_pa(p: PlantParameters, now: AirNow, node_pa: float, step_s: float) -> float:
    """Return the pressure upstream of the valve after `step_s`, with the flow at that pressure.

    s + (1 - kept) R m(s) = kept s_0 + (1 - kept) P_tank, for each tank: m grows with s and is 0 at
    the node's pressure, so the root lies between that and the right-hand side.
    """
    droop = p.effects.air.supply_droop
    idle_pa = rest_supply_pa(p, now, step_s)
    if droop.resistance_pa_s_per_kg <= 0.0 or now.tank_m2 <= 0.0:
        return idle_pa
    drop = droop_resistance(droop, step_s) * now.tank_m2
    one, other = node_pa, idle_pa
    miss_one, miss_other = node_pa - idle_pa, drop * port_flow(p, idle_pa, node_pa)
    for _ in range(60):
        if abs(one - other) < SOLVED_PA or miss_one == miss_other:
            break
        new = false_position(one, miss_one, other, miss_other)
        miss = new + drop * port_flow(p, new, node_pa) - idle_pa
        one, miss_one = keep_bracket_end(one, miss_one, other, miss_other, miss)
        other, miss_other = new, miss
        if abs(miss) < SOLVED_PA:
            break
    return other


def solve_feed(
    p: PlantParameters, now: AirNow, pressure_pa: float, later_pa: float, step_s: float
) -> MuscleFeed:
    """Return the feed after `step_s`, while the muscle's pressure changes linearly to `later_pa`.

    n - (1 - kept) drop(m(n)) = the pressure of the line's end without flow; m falls with n.
    """
    line, atmosphere_pa = p.effects.air.line_restriction, p.paper.atmospheric_pressure_pa
    if not restricts(line):
        supply_pa = solve_supply_pa(p, now, later_pa, step_s)
        return MuscleFeed(supply_pa, later_pa, flow_through_ports(p, now, supply_pa, later_pa))
    kept, weight = lag_weights(line_time_s(line, p.paper.specific_energy_j_per_kg), step_s)
    idle_pa = (
        kept * now.air.line_pa + (1.0 - kept) * pressure_pa + weight * (later_pa - pressure_pa)
    )
    given = 1.0 - kept
    one = idle_pa
    flow_one = flow_into(p, now, one, step_s)
    miss_one = -given * line_drop_pa(line, flow_one, later_pa, atmosphere_pa)
    other = max(now.tank_pa, idle_pa) if flow_one > 0.0 else min(atmosphere_pa, idle_pa)
    flow = flow_into(p, now, other, step_s)
    miss_other = other - idle_pa - given * line_drop_pa(line, flow, later_pa, atmosphere_pa)
    for _ in range(60):
        if abs(one - other) < SOLVED_PA or miss_one == miss_other:
            break
        new = false_position(one, miss_one, other, miss_other)
        flow = flow_into(p, now, new, step_s)
        miss = new - idle_pa - given * line_drop_pa(line, flow, later_pa, atmosphere_pa)
        one, miss_one = keep_bracket_end(one, miss_one, other, miss_other, miss)
        other, miss_other = new, miss
        if abs(miss) < SOLVED_PA:
            break
    supply_pa = solve_supply_pa(p, now, other, step_s)
    return MuscleFeed(supply_pa, other, flow_through_ports(p, now, supply_pa, other))


def flow_into(p: PlantParameters, now: AirNow, node_pa: float, step_s: float) -> float:
    """Return the mass flow into the node at a pressure, after the supply's response to `step_s`."""
    return flow_through_ports(p, now, solve_supply_pa(p, now, node_pa, step_s), node_pa)


def leak_flow(p: PlantParameters, now: AirNow, pressure_pa: float) -> float:
    """Return the mass flow into the muscle that bypasses the valve, kg/s; negative outwards."""
    if now.leak_m2 <= 0.0:
        return now.extra_kg_per_s
    leak = now.leak_m2 * port_flow(p, p.paper.atmospheric_pressure_pa, pressure_pa)
    return leak + now.extra_kg_per_s


def air_volume_m3(p: PlantParameters, position_m: float, pressure_pa: float) -> float:
    """Return the volume of the air: Eq. 2 with stretched threads, and added volumes."""
    braid = p.effects.air.braid_stretch
    if braid.compliance_per_pa == 0.0:
        room_m3 = volume_m3(p.paper, position_m)
    else:
        length = p.paper.rest_length_m - position_m
        stretched = p.paper.braid_length_m * stretch_ratio(
            braid, pressure_pa - p.paper.atmospheric_pressure_pa
        )
        room_m3 = length * (stretched * stretched - length * length) * p.paper.volume_scale
    room_m3 = pass_volume(p.effects.air, room_m3, position_m, pressure_pa)
    if p.terms is not None:
        gauge_pa = pressure_pa - p.paper.atmospheric_pressure_pa
        now = TermDrivers(position_m=position_m, gauge_pa=gauge_pa)
        added_m3 = push_of(p.terms.air, VOLUME_AT, NO_MEMORY, now)
        room_m3 = max(room_m3 + added_m3, LEAST_SHARE * room_m3)
    return room_m3


def share_heat(p: PlantParameters, begin: AirBegin, step_s: float) -> HeatShares:
    """Return what the walls leave of the air's excess temperature in a step."""
    if p.effects.air.polytropic.wall_time_s <= 0.0:
        return HeatShares(1.0, 1.0)
    rest_pa = p.paper.atmospheric_pressure_pa
    held = begin.pressure_pa * air_volume_m3(p, begin.position_m, begin.pressure_pa)
    mass = held / (begin.air.warmth * rest_pa * air_volume_m3(p, 0.0, rest_pa))
    return heat_shares(p.effects.air.polytropic, mass, step_s)


def step_exponent(p: PlantParameters, heat: HeatShares) -> float:
    """Return the exponent a of a step: the nearer to 1, the more heat the walls take in it."""
    exponent: float = p.effects.air.polytropic.exponent
    return exponent if heat.caused == 1.0 else 1.0 + heat.caused * (exponent - 1.0)


def worth_of_flow(
    p: PlantParameters,
    exponent: float,
    warmth: float,
    position_m: float,
    pressure_pa: float,
    net_kg_per_s: float,
) -> float:
    """Return what each unit of R T m adds to P V^a."""
    worth = polytropic_slope(exponent, air_volume_m3(p, position_m, pressure_pa))
    if net_kg_per_s < 0.0 and warmth != 1.0:
        worth *= outflow_energy(warmth)
    return worth


def exchange_heat(
    p: PlantParameters, begin: AirBegin, heat: HeatShares, end_pa: float, end_m: float
) -> tuple[float, float]:
    """Return pressure and T / T_0 after a step in which the walls took heat.

    The mass follows from the energy that flowed; what air leaves has the muscle's temperature.
    """
    if p.effects.air.polytropic.wall_time_s <= 0.0:
        return end_pa, 1.0
    exponent, warmth = step_exponent(p, heat), begin.air.warmth
    before = amount_of_air(p, exponent, begin.position_m, begin.pressure_pa)
    after = amount_of_air(p, exponent, end_m, end_pa)
    middle_m3 = air_volume_m3(p, begin.middle_m, 0.5 * (begin.pressure_pa + end_pa))
    came = (after - before) / polytropic_slope(exponent, middle_m3)
    held = begin.pressure_pa * air_volume_m3(p, begin.position_m, begin.pressure_pa) / warmth
    held += came if came > 0.0 else came / warmth
    energy = end_pa * air_volume_m3(p, end_m, end_pa)
    if held <= 0.0 or energy <= 0.0:
        return end_pa, 1.0
    reached = energy / held
    left = min(max(reached - (1.0 - heat.kept) * (warmth - 1.0), COLDEST), HOTTEST)
    return end_pa * left / reached, left


def amount_of_air(
    p: PlantParameters, exponent: float, position_m: float, pressure_pa: float
) -> float:
    """Return P V^a, the amount of air in the muscle in the sense of Eq. 7."""
    return pressure_pa * polytropic_volume(exponent, air_volume_m3(p, position_m, pressure_pa))


def solve_pressure_of_air(
    p: PlantParameters,
    exponent: float,
    air: float,
    position_m: float,
    line_m3: float,
    guess_pa: float,
) -> float:
    """Return the pressure at which the muscle and a part of the line hold `air` (P V^a)."""
    braid = p.effects.air.braid_stretch
    if braid.compliance_per_pa == 0.0:
        return air / (polytropic_volume(exponent, air_volume_m3(p, position_m, guess_pa)) + line_m3)
    pressure_pa = guess_pa
    length = p.paper.rest_length_m - position_m
    grows = (
        2.0 * length * p.paper.volume_scale * p.paper.braid_length_m**2 * braid.compliance_per_pa
    )
    for _ in range(4):  # Newton's method: the volume depends on the pressure
        room = air_volume_m3(p, position_m, pressure_pa)
        gauge_pa = pressure_pa - p.paper.atmospheric_pressure_pa
        slope = polytropic_slope(exponent, room) * grows * stretch_ratio(braid, gauge_pa)
        space = polytropic_volume(exponent, room) + line_m3
        pressure_pa -= (pressure_pa * space - air) / (space + pressure_pa * slope)
    return pressure_pa


def fill_chamber(
    p: PlantParameters,
    begin: AirBegin,
    fed_by: MuscleFeed,
    leak_kg_per_s: float,
    exponent: float,
    worth: float,
    end_m: float,
    step_s: float,
) -> tuple[float, float]:
    """Return the pressure of the muscle and of the line's end after `step_s` of constant flows.

    Air is conserved: air that the line's volume takes up does not reach the muscle.
    """
    line, pressure_pa, air = p.effects.air.line_restriction, begin.pressure_pa, begin.air
    energy = step_s * p.paper.specific_energy_j_per_kg
    amount = amount_of_air(p, exponent, begin.position_m, pressure_pa)
    if not restricts(line) and line.volume_m3 <= 0.0:
        amount += energy * (fed_by.inflow_kg_per_s + leak_kg_per_s) * worth
        end_pa = solve_pressure_of_air(p, exponent, amount, end_m, 0.0, pressure_pa)
        return end_pa, end_pa
    kept, weight = lag_weights(line_time_s(line, p.paper.specific_energy_j_per_kg), step_s)
    drop_pa = line_drop_pa(
        line, fed_by.inflow_kg_per_s, pressure_pa, p.paper.atmospheric_pressure_pa
    )
    idle_pa = kept * air.line_pa + (1.0 - kept) * (pressure_pa + drop_pa) - weight * pressure_pa
    inflow = energy * (fed_by.inflow_kg_per_s + leak_kg_per_s)
    amount += worth * (inflow - line.volume_m3 * (idle_pa - air.line_pa))
    line_m3 = worth * weight * line.volume_m3
    end_pa = solve_pressure_of_air(p, exponent, amount, end_m, line_m3, pressure_pa)
    return end_pa, idle_pa + weight * end_pa


def without_flow_pa(p: PlantParameters, begin: AirBegin, exponent: float, end_m: float) -> float:
    """Return the pressure after a step in which only the volume changes."""
    amount = amount_of_air(p, exponent, begin.position_m, begin.pressure_pa)
    return solve_pressure_of_air(p, exponent, amount, end_m, 0.0, begin.pressure_pa)


def net_flow(p: PlantParameters, now: AirNow, pressure_pa: float, step_s: float) -> float:
    """Return the total flow into the muscle at a pressure, kg/s."""
    return flow_into(p, now, pressure_pa, step_s) + leak_flow(p, now, pressure_pa)


def stop_at_balance(
    p: PlantParameters,
    begin: AirBegin,
    now: AirNow,
    exponent: float,
    end_m: float,
    pressure_pa: float,
    next_pa: float,
    net_kg_per_s: float,
) -> tuple[float, bool]:
    """Stop at the pressure where inflow and outflow balance; return whether it is reached.

    `net_kg_per_s` is the net flow at `pressure_pa`, which the caller has computed already. With one
    source the balance is at the source's pressure, as in `pressure_step`. With two, motion may
    carry the pressure across the balance: there the flow at the end of the step counts, and nothing
    is held. With a resistance in the line the flow decays smoothly and needs no stop.
    """
    step_s = 0.5 * begin.step_s
    if restricts(p.effects.air.line_restriction):
        return next_pa, False
    escapes = now.atmosphere_m2 > 0.0 or now.leak_m2 > 0.0
    escapes = escapes or now.extra_kg_per_s != 0.0
    if now.tank_m2 > 0.0 and escapes:
        comes = net_kg_per_s > 0.0
        if comes == (net_flow(p, now, next_pa, step_s) > 0.0):
            return next_pa, False
        still_pa = without_flow_pa(p, begin, exponent, end_m)
        worth = (next_pa - still_pa) / net_kg_per_s
        low = min(pressure_pa, min(next_pa, still_pa))
        high = max(pressure_pa, max(next_pa, still_pa))
        while high - low > 1e-3:
            between = 0.5 * (low + high)
            flow = net_flow(p, now, between, step_s)
            if between < still_pa + worth * flow:
                low = between
            else:
                high = between
        return low, False
    if now.tank_m2 <= 0.0 and not escapes:
        return next_pa, False
    source_pa = p.paper.atmospheric_pressure_pa
    if now.tank_m2 > 0.0:
        source_pa = rest_supply_pa(p, now, step_s)
    if (pressure_pa - source_pa) * (next_pa - source_pa) < 0.0:
        return source_pa, True
    return next_pa, next_pa == source_pa


def chamber_middle_pa(p: PlantParameters, begin: AirBegin) -> tuple[float, bool]:
    """Return the predicted absolute pressure in the middle of the step, and whether it balances."""
    pressure_pa, half_s = begin.pressure_pa, 0.5 * begin.step_s
    now = find_air_now(p, begin, pressure_pa, begin.position_m, begin.age_s)
    fed_by = solve_feed(p, now, pressure_pa, pressure_pa, half_s)
    leak = leak_flow(p, now, pressure_pa)
    net = fed_by.inflow_kg_per_s + leak
    exponent = step_exponent(p, share_heat(p, begin, half_s))
    worth = worth_of_flow(p, exponent, begin.air.warmth, begin.position_m, pressure_pa, net)
    middle_m = begin.middle_m
    middle_pa, _ = fill_chamber(p, begin, fed_by, leak, exponent, worth, middle_m, half_s)
    return stop_at_balance(p, begin, now, exponent, middle_m, pressure_pa, middle_pa, net)


def chamber_step(
    p: PlantParameters, begin: AirBegin, middle_pa: float, balanced: bool, end_m: float
) -> tuple[float, AirState]:
    """Advance the muscle's absolute pressure, the supply and the line by one midpoint step."""
    air, step_s, half_s = begin.air, begin.step_s, 0.5 * begin.step_s
    now = find_air_now(p, begin, middle_pa, begin.middle_m, begin.age_s + half_s)
    fed_by = solve_feed(p, now, begin.pressure_pa, middle_pa, half_s)
    supply_pa, branch_pa = advance_supply(p, now, fed_by, step_s)
    heat = share_heat(p, begin, step_s)
    if balanced:
        # See `pressure_step`: the flow ends within this step.
        end_pa, warmth = exchange_heat(p, begin, heat, middle_pa, end_m)
        return end_pa, AirState(supply_pa, end_pa, branch_pa, warmth)
    leak = leak_flow(p, now, middle_pa)
    net, exponent = fed_by.inflow_kg_per_s + leak, step_exponent(p, heat)
    worth = worth_of_flow(p, exponent, air.warmth, begin.middle_m, middle_pa, net)
    end_pa, line_pa = fill_chamber(p, begin, fed_by, leak, exponent, worth, end_m, step_s)
    if not restricts(p.effects.air.line_restriction):
        end_pa, _ = stop_at_balance(p, begin, now, exponent, end_m, middle_pa, end_pa, net)
    end_pa, warmth = exchange_heat(p, begin, heat, end_pa, end_m)
    if not restricts(p.effects.air.line_restriction):
        line_pa = end_pa
    elif p.effects.air.line_restriction.volume_m3 <= 0.0:
        # Without a volume the line's end follows the flow at the end of the step, not the middle's.
        ended = AirState(supply_pa, line_pa, branch_pa)
        later = AirNow(
            now.extra_kg_per_s, now.tank_pa, now.tank_m2, now.atmosphere_m2, now.leak_m2, ended
        )
        line_pa = solve_feed(p, later, end_pa, end_pa, half_s).node_pa
    return end_pa, AirState(supply_pa, line_pa, branch_pa, warmth)


def advance_supply(
    p: PlantParameters, now: AirNow, fed_by: MuscleFeed, step_s: float
) -> tuple[float, float]:
    """Return the supply's pressure after a step with the flow of the step's middle.

    The second is by how much the fast branch lowers it.
    """
    droop = p.effects.air.supply_droop
    if droop.resistance_pa_s_per_kg <= 0.0:
        return now.tank_pa, 0.0
    kept, given = kept_share(droop, step_s), 0.0
    if now.tank_m2 > 0.0:
        given = now.tank_m2 * port_flow(p, fed_by.supply_pa, fed_by.node_pa)
    dropped_pa = droop.resistance_pa_s_per_kg * given
    refilled_pa: float = now.tank_pa - (1.0 - droop.fast_share) * dropped_pa
    supply_pa = kept * now.air.supply_pa + (1.0 - kept) * refilled_pa
    if droop.fast_share <= 0.0:
        return supply_pa, 0.0
    kept = kept_of_branch(droop, step_s)
    return supply_pa, kept * now.air.branch_pa + (1.0 - kept) * droop.fast_share * dropped_pa


def pressure_behind_line_pa(
    p: PlantParameters,
    pressure_pa: float,
    begin_pa: float,
    end_pa: float,
    position_m: float,
    velocity_m_per_s: float,
    step_s: float,
) -> float:
    """Return the muscle's pressure after a step, from the sensor's pressure at both ends of it.

    The muscle fills through the line from the sensor's end, with a lag of drop / flow V / (R T).
    """
    drop_pa = 0.5 * (begin_pa + end_pa) - pressure_pa
    resistance = resistance_at_drop(
        p.effects.air.line_restriction, drop_pa, pressure_pa, p.paper.atmospheric_pressure_pa
    )
    room = air_volume_m3(p, position_m, pressure_pa)
    kept, weight = lag_weights(resistance * room / p.paper.specific_energy_j_per_kg, step_s)
    lagged_pa = kept * pressure_pa + (1.0 - kept) * begin_pa + weight * (end_pa - begin_pa)
    grown = air_volume_m3(p, position_m + step_s * velocity_m_per_s, pressure_pa) / room
    return lagged_pa - kept * pressure_pa * (grown - 1.0)
