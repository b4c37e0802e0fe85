"""What may be hidden in a rig, and how large: the sizes, and the forms the truth gives them.

A size is a multiple of the smallest that would matter to a user (1, 3 or 10); the real value is
drawn within 15 % of it, so that nobody can know it. Where an effect has more than one form in
nature, the truth takes one that a catalogue of simple kernels is unlikely to hold.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hidden.equations.truth import Truth
from hidden.sensors import Sensors

Size = float | tuple[float, str]
"""A multiple of the smallest size of interest; or that, and the form."""

Change = Callable[[float, np.random.Generator], Mapping[str, float]]

IN_TRUTH: dict[str, Change] = {
    # --- valve
    "valve_deadband": lambda s, rng: {
        "overlap_fill_v": 0.05 * s * rng.uniform(0.7, 1.3),
        "overlap_vent_v": 0.05 * s * rng.uniform(0.7, 1.3),
    },
    "valve_asymmetry": lambda s, _: {"vent_gain": 1.0 - 0.03 * s},
    "valve_saturation": lambda s, _: {"drive_limit_v": 5.0 - 0.2 * s},
    "valve_curve": lambda s, _: {"curve_per_v": 0.006 * s},
    "valve_curve/power": lambda s, _: {"curve_exponent": 1.0 + 0.03 * s},
    "valve_spool": lambda s, rng: {
        "spool_rad_per_s": 2.0 * math.pi * 330.0 / s,
        "spool_damping": rng.uniform(0.5, 1.0),
    },
    "valve_hysteresis": lambda s, _: {"play_v": 0.03 * s},
    "valve_leak": lambda s, _: {"null_leak_m2": 5e-9 * s, "null_leak_zone_v": 1.5},
    "valve_leak/everywhere": lambda s, _: {"null_leak_m2": 5e-9 * s},
    "command_delay": lambda s, _: {"delay_s": 0.3e-3 * s},
    # --- chamber and supply
    "chamber_leak": lambda s, _: {"chamber_leak_m2": 3e-9 * s},
    "discharge_ratio": lambda s, _: {"critical_ratio": 0.528 - 0.025 * s},
    "supply_droop": lambda s, rng: {
        "regulator_pa_s_per_kg": 1e6 * s,
        "tank_m3": rng.uniform(0.03, 0.08) * 78.4e3 / (1e6 * s),
    },
    "supply_droop/static": lambda s, _: {
        "regulator_pa_s_per_kg": 1e6 * s,
        "tank_m3": 0.2e-3 * 78.4e3 / (1e6 * s),
    },
    "line_restriction": lambda s, rng: {
        "line_pa_s_per_kg": 1e6 * s,
        "line_m3": rng.uniform(2e-6, 5e-6),
    },
    "dead_volume": lambda s, _: {"dead_m3": 2e-6 * s},
    "polytropic": lambda s, _: {"polytropic": 1.0 + 0.03 * s},
    "polytropic/wall_heat": lambda s, _: {"wall_heat_w_per_k": 30.0 / s},
    # --- mechanics
    "presliding": lambda s, rng: {
        "bristle_n_per_m": 1e6 / s,
        "bristle_n_s_per_m": rng.uniform(5.0, 30.0),
    },
    "presliding/maxwell_slip": lambda s, _: {"slip_n_per_m": 1e6 / s},
    "stribeck": lambda s, rng: {
        "stribeck": 0.04 * s,
        "stribeck_m_per_s": 5e-3 * rng.uniform(0.6, 2.0),
    },
    "stribeck/tustin": lambda s, rng: {
        "stribeck": 0.04 * s,
        "stribeck_m_per_s": 5e-3 * rng.uniform(0.6, 2.0),
        "stribeck_exponent": 1.0,
    },
    "return_friction": lambda s, _: {"return_share": 0.025 * s},
    "coulomb_friction": lambda s, _: {"coulomb_n": 0.3 * s},
    "pressure_damping": lambda s, _: {"pressure_damping": 5e-5 * s},
    "braid_drag": lambda s, _: {"braid_drag": -0.05 * s},
    "cubic_stiffness": lambda s, _: {"cubic": 2e5 * s},
    "creep": lambda s, rng: {
        "creep_n_per_m": 50.0 * s,
        "creep_s": math.exp(rng.uniform(math.log(0.5), math.log(2.0))),
    },
    "creep/two_branches": lambda s, _: {
        "creep_n_per_m": 50.0 * s,
        "creep_s": 3.0,
        "creep_fast_share": 0.4,
    },
    "bladder_threshold": lambda s, _: {"threshold_pa": 1e3 * s},
    "braid_stretch": lambda s, _: {"stretch_per_pa": 1e-8 * s},
    "end_cap": lambda s, _: {"cap_m": 1e-3 * s},
    "external_load": lambda s, _: {"load_n": 0.5 * s},
    "moving_mass": lambda s, _: {"mass_kg": 0.05 + 0.03 * s},
    # --- sensors with dynamics, and time
    "pressure_sensor_lag": lambda s, _: {"sensor_lag_s": 0.4e-3 * s},
    "encoder_backlash": lambda s, _: {"backlash_m": 12e-6 * s},
    "drift": lambda s, _: {"gain_trend_per_s": 0.01 * s / 60.0},
    # --- in no catalogue
    "position_dependent_friction": lambda s, _: {"mu_slope_per_m": 5.0 * s},
    "supply_ripple": lambda s, _: {"ripple_pa": 1.7e3 * s},
    "hysteretic_spring": lambda s, _: {"loop_n": 0.5 * s, "loop_m": 1.5e-3},
    "valve_gain_wobble": lambda s, _: {"gain_wobble": 0.01 * s, "gain_wobble_hz": 0.13},
    "second_spring": lambda s, _: {"stop_m": 14e-3, "stop_n_per_m": 300.0 * s},
    "wearing_friction": lambda s, _: {"mu_decay_per_s": 0.01 * s},
    "slewing_driver": lambda s, _: {"slew_v_per_s": 4e3 / s},
    "swelling_hose": lambda s, _: {"hose_m3_per_pa": 4e-12 * s},
    "friction_with_pressure": lambda s, _: {"mu_per_pa": 3e-7 * s},
    "drag_along_stroke": lambda s, _: {"drag_per_m": 3e3 * s},
    "pull_along_stroke": lambda s, _: {"pull_per_m": 0.7 * s},
}

ON_SENSORS: dict[str, Change] = {
    "pressure_sensor_offset": lambda s, _: {"pressure_offset_pa": 1e3 * s},
    "pressure_sensor_gain": lambda s, _: {"pressure_gain": 1.0 + 0.006 * s},
    "encoder_scale": lambda s, _: {"encoder_scale": 1.0 + 0.004 * s},
}

OUT_OF_CATALOGUE = ("valve_gain_wobble", "second_spring", "wearing_friction")

CALLED = {
    "position_dependent_friction": "position_friction",
    "supply_ripple": "supply_ripple",
    "hysteretic_spring": "spring_hysteresis",
}
"""Once in no catalogue: the truth's name, and that of the effect which has come since."""

PRESSURE_BLOCK = (
    "valve_deadband", "valve_asymmetry", "valve_saturation", "valve_curve", "valve_spool",
    "valve_hysteresis", "valve_leak", "command_delay", "chamber_leak", "discharge_ratio",
    "supply_droop", "line_restriction", "dead_volume", "polytropic",
)  # fmt: skip

MECHANICAL_BLOCK = (
    "presliding", "stribeck", "return_friction", "coulomb_friction", "pressure_damping",
    "cubic_stiffness", "creep", "bladder_threshold", "braid_stretch", "end_cap", "external_load",
    "encoder_scale", "encoder_backlash",
)  # fmt: skip

ON_BOTH_BLOCKS = ("pressure_sensor_lag", "pressure_sensor_offset", "pressure_sensor_gain")

SINGLES = (*PRESSURE_BLOCK, *MECHANICAL_BLOCK, *ON_BOTH_BLOCKS)
"""The effects that a diagnosis is asked to name."""


def apply(
    effects: Mapping[str, Size], truth: Truth, sensors: Sensors, rng: np.random.Generator
) -> tuple[Truth, Sensors]:
    """Hide the effects; size 0 hides nothing."""
    for name, size in effects.items():
        multiple, form = size if isinstance(size, tuple) else (size, "")
        key = f"{name}/{form}" if form else name
        real = multiple * rng.uniform(0.87, 1.15)
        if multiple == 0:
            continue
        if key in ON_SENSORS:
            changes: dict[str, Any] = dict(ON_SENSORS[key](real, rng))
            sensors = replace(sensors, **changes)
        else:
            truth = truth._replace(**IN_TRUTH[key](real, rng))
    return truth, sensors
