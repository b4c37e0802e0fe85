"""One small step of the truth, and many of them between two readings."""

from __future__ import annotations

import math

from hidden.equations.air import (
    air_after,
    air_of,
    fast_tank_after,
    flows,
    gas_after,
    pressure_of,
    supply_pa,
    tank_after,
)
from hidden.equations.mechanism import (
    SLIP_A,
    SLIP_B,
    SLIP_C,
    SLIP_D,
    band,
    drag,
    dragged,
    elastic,
    loop_after,
    pull,
    strained,
    velocity_after,
)
from hidden.equations.physics import volume
from hidden.equations.truth import State
from hidden.equations.valve import opening, play, slewed, spool


def at_rest(p, command_v):
    """Return a vented rig that has stood still for long, its encoder at the true position."""
    x = 0.0 if p.direct == 1.0 else -p.load_n / p.stiffness
    vented = p.atmosphere_pa
    return State(
        t_s=0.0,
        play_v=command_v,
        spool_v=command_v,
        spool_rate=0.0,
        air=air_of(p, vented, x),
        gas_k=p.wall_k,
        line_air=vented * p.line_m3,
        tank_pa=supply_pa(p, 0.0),
        fast_tank_pa=0.0,
        pressure_pa=vented,
        line_pa=vented,
        x=x,
        v=0.0,
        bristle_n=0.0,
        slip_1=0.0,
        slip_2=0.0,
        slip_3=0.0,
        slip_4=0.0,
        creep_slow_m=x,
        creep_fast_m=x,
        loop_n=0.0,
        sensed_pa=vented,
        geared_m=x,
    )


def line_flow(p, entering, line_pa, muscle_pa, h):
    """Return the flow from the line into the muscle, the stiff pair solved implicitly."""
    swell = h * p.gas_j_per_kg_k * p.wall_k / p.line_m3
    given = line_pa - muscle_pa + swell * entering
    flow = given / (p.line_pa_s_per_kg + swell)
    if p.line_pa_s2_per_kg2 > 0.0:  # P_1^2 - P^2 = 2 P_atm R_t g|g|, by Newton's method
        rough = 2.0 * p.atmosphere_pa * p.line_pa_s2_per_kg2
        for _ in range(8):
            end_pa = math.sqrt(max(muscle_pa * muscle_pa + rough * flow * abs(flow), 1.0))
            miss = (p.line_pa_s_per_kg + swell) * flow + end_pa - muscle_pa - given
            flow -= miss / (p.line_pa_s_per_kg + swell + rough * abs(flow) / end_pa)
    return flow


def moved(p, s, gauge_pa, force_n, x, h):
    """Return (velocity, bristle forces) after h, under the pressure of the middle of h."""
    low, high = band(p, x, gauge_pa, s.v, s.t_s)
    net = pull(p, x, gauge_pa, force_n) - elastic(p, s, x, s.t_s)
    ahead, back = drag(p, x, gauge_pa, True, s.t_s), drag(p, x, gauge_pa, False, s.t_s)
    if p.bristle_n_per_m > 0.0:
        half = strained(s.bristle_n, p.bristle_n_per_m, low, high, 0.5 * h * s.v)
        limit = high if s.v > 0.0 else low
        bend = p.bristle_n_s_per_m * abs(limit - half) / max(high - low, 1e-9)
        v = velocity_after(p, s.v, net, ahead + bend, back + bend, half, half, h)
        after = strained(s.bristle_n, p.bristle_n_per_m, low, high, 0.5 * h * (s.v + v))
        return v, after, 0.0, 0.0, 0.0, 0.0
    if p.slip_n_per_m > 0.0:
        way, each = 0.5 * h * s.v, 0.25 * p.slip_n_per_m
        a, b, c, d = SLIP_A, SLIP_B, SLIP_C, SLIP_D
        half = (
            dragged(s.slip_1, each, a * low, a * high, way)
            + dragged(s.slip_2, each, b * low, b * high, way)
            + dragged(s.slip_3, each, c * low, c * high, way)
            + dragged(s.slip_4, each, d * low, d * high, way)
        )
        v = velocity_after(p, s.v, net, ahead, back, half, half, h)
        way = 0.5 * h * (s.v + v)
        return (
            v,
            0.0,
            dragged(s.slip_1, each, a * low, a * high, way),
            dragged(s.slip_2, each, b * low, b * high, way),
            dragged(s.slip_3, each, c * low, c * high, way),
            dragged(s.slip_4, each, d * low, d * high, way),
        )
    v = velocity_after(p, s.v, net, ahead, back, low, high, h)
    return v, 0.0, 0.0, 0.0, 0.0, 0.0


def followed(z, before, after, time, h):
    """Return a first-order lag after h, in which its target goes from one value to another."""
    middle = 0.5 * (before + after)
    return middle + (z - middle) * math.exp(-h / time) if time > 0.0 else after


def small_step(p, s, command_v, force_n, h):
    """Advance by h: midpoint rule for the air, trapezoidal rule for the mechanism."""
    drive = min(max(command_v + p.null_v, -p.drive_limit_v), p.drive_limit_v)
    play_v = slewed(p, s.play_v, play(s.play_v, drive, p.play_v), h)
    spool_v, spool_rate = spool(p, s.spool_v, s.spool_rate, play_v, h)
    middle_v = 0.5 * (s.spool_v + spool_v) if p.spool_rad_per_s > 0.0 else spool_v
    area = opening(p, middle_v, s.t_s + 0.5 * h)

    has_line = p.line_pa_s_per_kg > 0.0
    tank_pa = s.tank_pa - s.fast_tank_pa
    port_pa = s.line_pa if has_line else s.pressure_pa
    x_mid = s.x + 0.5 * h * s.v
    taken, entering, lost = flows(p, area, middle_v, tank_pa, port_pa, s.pressure_pa, s.gas_k)
    if has_line:
        entering = line_flow(p, entering, s.line_pa, s.pressure_pa, h)
    half_air = air_after(p, s.air, entering - lost, s.pressure_pa, s.x, 0.5 * h)
    half_pa = pressure_of(p, half_air, s.gas_k, x_mid, s.pressure_pa)

    v, bristle, slip_1, slip_2, slip_3, slip_4 = moved(
        p, s, half_pa - p.atmosphere_pa, force_n, x_mid, h
    )
    way = 0.5 * h * (s.v + v)
    x = s.x + way

    if has_line:
        line_air = s.line_air
        taken, at_port, lost = flows(p, area, middle_v, tank_pa, s.line_pa, half_pa, s.gas_k)
        entering = line_flow(p, at_port, s.line_pa, half_pa, h)
        line_air += h * p.gas_j_per_kg_k * p.wall_k * (at_port - entering)
    else:
        line_air = s.line_air
        taken, entering, lost = flows(p, area, middle_v, tank_pa, half_pa, half_pa, s.gas_k)
    air = air_after(p, s.air, entering - lost, half_pa, x_mid, h)
    growth = volume_growth(p, s.x, x, half_pa - p.atmosphere_pa) / h
    gas_k = gas_after(p, air, s.gas_k, entering - lost, half_pa * growth, h)
    pressure = pressure_of(p, air, gas_k, x, half_pa)
    line_pa = line_air / p.line_m3 if has_line else pressure
    return State(
        t_s=s.t_s + h,
        play_v=play_v,
        spool_v=spool_v,
        spool_rate=spool_rate,
        air=air,
        gas_k=gas_k,
        line_air=line_air,
        tank_pa=tank_after(p, s.tank_pa, taken, s.t_s, h),
        fast_tank_pa=fast_tank_after(p, s.fast_tank_pa, taken, h),
        pressure_pa=pressure,
        line_pa=line_pa,
        x=x,
        v=v,
        bristle_n=bristle,
        slip_1=slip_1,
        slip_2=slip_2,
        slip_3=slip_3,
        slip_4=slip_4,
        creep_slow_m=followed(s.creep_slow_m, s.x, x, p.creep_s, h),
        creep_fast_m=followed(s.creep_fast_m, s.x, x, 0.1 * p.creep_s, h),
        loop_n=loop_after(p, s.loop_n, way),
        sensed_pa=followed(s.sensed_pa, s.line_pa, line_pa, p.sensor_lag_s, h),
        geared_m=play(s.geared_m, x, p.backlash_m),
    )


def volume_growth(p, x, x_after, gauge_pa):
    """Return the change of the muscle's volume at one pressure."""
    return volume(p, x_after, gauge_pa) - volume(p, x, gauge_pa)
