"""The hidden numbers beside those that a diagnosis reports, under the catalogue's names."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from hidden.rig import HiddenRig

Number = Callable[[HiddenRig], float]


def _refill_s(rig: HiddenRig) -> float:
    t = rig.truth
    return t.tank_m3 * t.regulator_pa_s_per_kg / (t.gas_j_per_kg_k * t.wall_k)


TRUE: Mapping[str, Mapping[str, Number]] = {
    "valve_deadband": {
        "fill_width_v": lambda rig: rig.truth.overlap_fill_v,
        "exhaust_width_v": lambda rig: rig.truth.overlap_vent_v,
    },
    "valve_asymmetry": {"exhaust_gain": lambda rig: rig.truth.vent_gain},
    "valve_saturation": {"shortfall_v": lambda rig: 5.0 - rig.truth.drive_limit_v},
    "valve_curve": {"curvature_per_v": lambda rig: rig.truth.curve_per_v},
    "valve_spool": {"time_constant_s": lambda rig: 1.0 / rig.truth.spool_rad_per_s},
    "valve_hysteresis": {"width_v": lambda rig: rig.truth.play_v},
    "command_delay": {"delay_s": lambda rig: rig.truth.delay_s},
    "chamber_leak": {"area_m2": lambda rig: rig.truth.chamber_leak_m2},
    "supply_droop": {
        "resistance_pa_s_per_kg": lambda rig: rig.truth.regulator_pa_s_per_kg,
        "refill_time_s": _refill_s,
    },
    "line_restriction": {"resistance_pa_s_per_kg": lambda rig: rig.truth.line_pa_s_per_kg},
    "dead_volume": {"volume_m3": lambda rig: rig.truth.dead_m3},
    "polytropic": {"exponent": lambda rig: rig.truth.polytropic},
    "stribeck": {
        "rise": lambda rig: rig.truth.stribeck,
        "speed_m_per_s": lambda rig: rig.truth.stribeck_m_per_s,
    },
    "pressure_damping": {"per_pa": lambda rig: rig.truth.pressure_damping},
    "return_friction": {"share": lambda rig: rig.truth.return_share},
    "coulomb_friction": {"force_n": lambda rig: rig.truth.coulomb_n},
    "cubic_stiffness": {"n_per_m3": lambda rig: rig.truth.cubic},
    "creep": {
        "stiffness_n_per_m": lambda rig: rig.truth.creep_n_per_m,
        "time_constant_s": lambda rig: rig.truth.creep_s,
    },
    "bladder_threshold": {"pressure_pa": lambda rig: rig.truth.threshold_pa},
    "braid_stretch": {"compliance_per_pa": lambda rig: rig.truth.stretch_per_pa},
    "end_cap": {"length_m": lambda rig: rig.truth.cap_m},
    "external_load": {"force_n": lambda rig: rig.truth.load_n},
    "encoder_scale": {"scale": lambda rig: rig.sensors.encoder_scale},
    "encoder_backlash": {"width_m": lambda rig: rig.truth.backlash_m},
    "pressure_sensor_lag": {"time_constant_s": lambda rig: rig.truth.sensor_lag_s},
    "pressure_sensor_offset": {"offset_pa": lambda rig: rig.sensors.pressure_offset_pa},
    "pressure_sensor_gain": {"gain": lambda rig: rig.sensors.pressure_gain},
}
"""Only numbers that mean the same in both forms; LuGre and a two-zone leak have none."""

NEUTRAL = {"exhaust_gain": 1.0, "exponent": 1.0, "scale": 1.0, "gain": 1.0}
"""Where it is not zero: an error is a share of the distance from neutral."""
