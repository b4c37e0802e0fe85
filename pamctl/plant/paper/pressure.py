"""The pressure block: valve opening and motion in, pressure out.

Eq. 7 is integrated as d(P V)/dt = R T m_dot. This form conserves the air mass
exactly for any step, and needs no velocity: a measured, quantised position can drive it.
"""

from __future__ import annotations

from pamctl.plant.paper.muscle import volume_m3
from pamctl.plant.paper.valve import valve_flow
from pamctl.plant.parameters import PaperParameters


def middle_pressure_pa(
    p: PaperParameters,
    pressure_pa: float,
    opening_v: float,
    position_m: float,
    middle_m: float,
    step_s: float,
) -> float:
    """Predict the absolute pressure in the middle of the step."""
    energy = pressure_pa * volume_m3(p, position_m)
    inflow = valve_flow(p, opening_v, pressure_pa)
    filled = energy + 0.5 * step_s * p.specific_energy_j_per_kg * inflow
    return _stop_at_source(p, opening_v, pressure_pa, filled / volume_m3(p, middle_m))


def pressure_step(
    p: PaperParameters,
    pressure_pa: float,
    middle_pa: float,
    opening_v: float,
    position_m: float,
    end_m: float,
    step_s: float,
) -> float:
    """Advance the absolute pressure of Eq. 7 and 8 by one midpoint step.

    `opening_v` is the valve's opening in the middle of the step, in volts of command.
    """
    if opening_v != 0.0:
        source_pa = p.tank_pressure_pa if opening_v > 0.0 else p.atmospheric_pressure_pa
        if middle_pa == source_pa:
            # The prediction reached the end within half a step of the first flow. The flow goes
            # as the root of the difference: the true time is twice that, and ends in this step.
            return middle_pa
    energy = pressure_pa * volume_m3(p, position_m)
    inflow = valve_flow(p, opening_v, middle_pa)
    filled = energy + step_s * p.specific_energy_j_per_kg * inflow
    return _stop_at_source(p, opening_v, middle_pa, filled / volume_m3(p, end_m))


def _stop_at_source(
    p: PaperParameters, opening_v: float, pressure_pa: float, next_pa: float
) -> float:
    """Stop at the source's pressure.

    The flow goes as the square root of the pressure difference, and reaches zero in finite time.
    An explicit step would overshoot and chatter by some 30 Pa.
    """
    if opening_v == 0.0:
        return next_pa
    source_pa = p.tank_pressure_pa if opening_v > 0.0 else p.atmospheric_pressure_pa
    if (pressure_pa - source_pa) * (next_pa - source_pa) < 0.0:
        return source_pa
    return next_pa
