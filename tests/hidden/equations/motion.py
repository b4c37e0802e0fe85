"""One small step of the truth, many of them between two readings, and whole records."""

from __future__ import annotations

import math
from typing import Any

from hidden.equations.air import (
    air_after,
    air_of,
    fast_tank_after,
    flows,
    gas_after,
    opening,
    play,
    pressure_of,
    slewed,
    spool,
    supply_pa,
    tank_after,
    volume,
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
from hidden.equations.truth import State, Truth
from pamctl.kernel.calls import Call, prepare


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


def between_readings(
    p, state, since, until, times, volts, written, arrived, start_force, force_rate, longest
):
    """Move from one reading to the next.

    The first `written` of `times` and `volts` have been asked for so far; what arrives at the
    driver is `delay_s` older. Returns the state and the index of the voltage that has arrived.
    """
    steps = max(math.ceil((until - since) / longest - 1e-9), 1)
    h = (until - since) / steps
    now = since
    for k in range(steps):
        end = since + (k + 1) * h
        while now < end:
            stop = end
            if arrived + 1 < written:
                change = times[arrived + 1] + p.delay_s
                if change <= now:
                    arrived += 1
                    continue
                stop = min(end, change)  # a flow is not linear in the opening: no averaging
            force = start_force + force_rate * (0.5 * (now + stop) - since)
            state = small_step(p, state, volts[arrived], force, stop - now)
            now = stop
    return state, arrived


def fill_open_loop(p, state, times, volts, forces, longest, seen):
    """Fill (sensed pressure, sensed position, true pressure, true position) at the readings."""
    n = len(times)
    arrived = 0
    for k in range(n):
        seen[0, k] = state.sensed_pa
        seen[1, k] = state.geared_m
        seen[2, k] = state.pressure_pa
        seen[3, k] = state.x
        if k + 1 < n:
            rate = (forces[k + 1] - forces[k]) / (times[k + 1] - times[k])
            state, arrived = between_readings(
                p, state, times[k], times[k + 1], times, volts, k + 1, arrived,
                forces[k], rate, longest,
            )  # fmt: skip


def fill_closed_loop(
    p, state, times, wanted, rest_s, rest_v, gains, reading, noise, longest, seen, volts
):
    """Fill what `fill_open_loop` does, and the volts that a PID on the readings asked for.

    `gains` are (V/m, V/(m s), V s/m, V/Pa on the pressure's fast part); `reading` is (counts
    per metre, phase, pressure gain, pressure offset, AO step), `noise` in Pa.
    """
    n = len(times)
    proportional, integral, derivative, damping = gains[0], gains[1], gains[2], gains[3]
    per_m, phase, pressure_gain = reading[0], reading[1], reading[2]
    pressure_offset, step_v = reading[3], reading[4]
    arrived, total, slope, slow = 0, 0.0, 0.0, p.atmosphere_pa
    before = math.floor(state.geared_m * per_m + phase) / per_m
    for k in range(n):
        seen[0, k] = state.sensed_pa
        seen[1, k] = state.geared_m
        seen[2, k] = state.pressure_pa
        seen[3, k] = state.x
        dt = times[k] - times[k - 1] if k > 0 else 1e-3
        position = math.floor(state.geared_m * per_m + phase) / per_m
        pressure = (
            p.atmosphere_pa
            + pressure_gain * (state.sensed_pa - p.atmosphere_pa)
            + pressure_offset
            + noise[k]
        )
        slope += dt / 8e-3 * ((position - before) / dt - slope)
        slow += dt / 50e-3 * (pressure - slow)
        before = position
        error = wanted[k] - position
        if times[k] < rest_s:
            u = rest_v
        else:
            u = proportional * error + integral * total - derivative * slope
            u -= damping * (pressure - slow)
            if abs(u) < 5.0:
                total += error * dt
        volts[k] = round(min(max(u, -5.0), 5.0) / step_v) * step_v
        if k + 1 < n:
            state, arrived = between_readings(
                p, state, times[k], times[k + 1], times, volts, k + 1, arrived,
                0.0, 0.0, longest,
            )  # fmt: skip


def settled(p, state, volts, seconds, longest):
    """Return the state after holding one voltage for long, its clock set back to zero."""
    for _ in range(math.ceil(seconds / longest)):
        state = small_step(p, state, volts, 0.0, longest)
    return state


def settle(truth: Truth, rest_v: float, step_s: float) -> State:
    """Return a rig that has been vented under this voltage, its clock at zero."""
    start: State = at_rest(truth, rest_v)
    given = {"p": truth, "state": start, "volts": rest_v, "seconds": 0.3, "longest": step_s}
    call = prepare(settled, given, updates=("state",))
    call.run()
    state: State = call.get("state")
    return state._replace(t_s=0.0)


def prepare_passage(truth: Truth, state: State, times: Any, volts: Any, step_s: float) -> Call:
    """Return the call of `between_readings` that goes on from reading to reading."""
    given = {
        "p": truth, "state": state, "since": 0.0, "until": 0.0, "times": times, "volts": volts,
        "written": 0, "arrived": 0, "start_force": 0.0, "force_rate": 0.0, "longest": step_s,
    }  # fmt: skip
    return prepare(between_readings, given, updates=("state", "arrived"))
