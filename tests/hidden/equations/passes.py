"""A truth's passage through a whole record: between readings it moves, at readings it is read."""

from __future__ import annotations

import math

from hidden.equations.advance import small_step


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
