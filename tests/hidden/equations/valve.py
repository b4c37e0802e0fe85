"""From the voltage that arrives at the driver to an opening: play, spool, laps, ports."""

from __future__ import annotations

import math


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
