"""What the rig did in a window, for each block: limits are by activity, and a rest shows little."""

from __future__ import annotations

import numpy as np

from pamctl.diagnose.measured.record import Array, Record
from pamctl.plant.parameters import PlantParameters

REST, FILLING, EXHAUST, CHOKED, SWING = "rest", "filling", "exhaust", "choked flow", "swing"
CONTRACTION, EXTENSION, STROKE = "contraction", "extension", "strokes"
FLOW_V = 0.3
"""RMS of a command that moves air (V)."""
MOVED_NOISES = 20.0
"""A pressure that moves by this multiple of its noise shows the valve."""
CHOKED_SHARE = 0.05
"""Share of a window with choked flow at a large command."""
LARGE_V = 2.0
MOVED_STEPS = 30.0
"""A motion of this many deviations of the encoder's reading shows friction and spring."""
ONE_WAY = 0.9


def find_pressure_activity(
    record: Record, judged: Array, p: PlantParameters, noise_pa: float
) -> tuple[str, bool]:
    """Return what the valve did, and whether that can confirm the pressure block."""
    pressure_pa, valve_v = record["pressure_pa"][judged], record["valve_v"][judged]
    low_pa, high_pa = np.quantile(pressure_pa, [0.02, 0.98])
    moved = high_pa - low_pa > MOVED_NOISES * noise_pa
    if not moved or float(np.sqrt(np.mean(valve_v**2))) < FLOW_V / 10.0:
        return REST, False
    numbers = p.paper
    ratio = np.where(
        valve_v > 0.0,
        pressure_pa / numbers.tank_pressure_pa,
        numbers.atmospheric_pressure_pa / np.maximum(pressure_pa, 1.0),
    )
    choked = (np.abs(valve_v) > LARGE_V) & (ratio < numbers.critical_ratio)
    return (CHOKED if float(np.mean(choked)) > CHOKED_SHARE else SWING), True


def find_mechanics_activity(record: Record, judged: Array, noise_m: float) -> tuple[str, bool]:
    """Return how the muscle moved, and whether that can confirm the mechanics."""
    position_m = record["position_m"][judged]
    span_m = float(np.ptp(position_m))
    if span_m < MOVED_STEPS * noise_m:
        return REST, False
    net_m = float(position_m[-1] - position_m[0])
    if abs(net_m) < ONE_WAY * span_m:
        return STROKE, True
    return (CONTRACTION if net_m > 0.0 else EXTENSION), True
