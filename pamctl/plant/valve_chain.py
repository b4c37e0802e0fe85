"""From the command to the valve's opening: what the paper takes for one and the same."""

from __future__ import annotations

from pamctl.plant.effects import ValveEffects
from pamctl.plant.effects.mechanics.drift import drift_factor
from pamctl.plant.effects.valve.valve_asymmetry import apply_asymmetry_v
from pamctl.plant.effects.valve.valve_curve import apply_curve_v
from pamctl.plant.effects.valve.valve_deadband import apply_deadband_v
from pamctl.plant.effects.valve.valve_hysteresis import follow_hysteresis_v
from pamctl.plant.effects.valve.valve_saturation import saturate_command_v
from pamctl.plant.effects.valve.valve_spool import spool_step
from pamctl.plant.parameters import ValveState


def valve_step(
    e: ValveEffects, valve: ValveState, command_v: float, step_s: float
) -> tuple[float, ValveState]:
    """Return the opening in the middle of the step, and the valve at its end.

    The opening is that of the paper's valve with the same area, in volts of command.
    """
    half_s = 0.5 * step_s
    pushed_v = follow_hysteresis_v(
        e.valve_hysteresis, valve.play_v, saturate_command_v(e.valve_saturation, command_v)
    )
    middle_v, rate = spool_step(
        e.valve_spool, valve.spool_v, valve.spool_rate_v_per_s, pushed_v, half_s
    )
    spool_v, spool_rate = spool_step(e.valve_spool, middle_v, rate, pushed_v, half_s)
    area_v = apply_curve_v(e.valve_curve, apply_deadband_v(e.valve_deadband, middle_v))
    gain = drift_factor(e.drift.valve_gain_per_s, valve.age_s + half_s)
    opening_v = gain * apply_asymmetry_v(e.valve_asymmetry, area_v)
    return opening_v, ValveState(spool_v, spool_rate, pushed_v, valve.age_s + step_s)
