"""What a hidden rig is made of: the paper's muscle and valve, and what the paper leaves out."""

from __future__ import annotations

from typing import NamedTuple


class Truth(NamedTuple):
    """A rig as it really is. SI; every default is the paper's (Tables I, II) or absent."""

    # Table I
    mass_kg: float = 0.05
    damping: float = 570.0
    stiffness: float = 9680.0
    rest_length_m: float = 0.2
    braid_m: float = 0.232
    turns: float = 1.94
    mu_k: float = 55.3
    braids: float = 100.0
    contact_m2: float = 0.233e-6
    # Table II
    supply_pa: float = 441.3e3
    atmosphere_pa: float = 101.3e3
    gas_j_per_kg_k: float = 287.1
    wall_k: float = 273.0
    valve_m2_per_v: float = 1.03e-6
    heat_ratio: float = 1.4

    # --- valve
    null_v: float = 0.0
    overlap_fill_v: float = 0.0
    overlap_vent_v: float = 0.0
    vent_gain: float = 1.0
    drive_limit_v: float = 99.0
    curve_per_v: float = 0.0
    curve_exponent: float = 1.0
    """A_v grows as |u|^exponent, equal to the straight line at 5 V."""
    spool_rad_per_s: float = 0.0
    """0: the spool follows at once."""
    spool_damping: float = 0.7
    play_v: float = 0.0
    slew_v_per_s: float = 0.0
    """0: the driver follows at any rate."""
    delay_s: float = 0.0
    null_leak_m2: float = 0.0
    null_leak_zone_v: float = 0.0
    """Beyond it the laps cover half of the leak; 0: the leak is the same everywhere."""
    null_leak_fade_per_v: float = 0.0
    gain_wobble: float = 0.0
    gain_wobble_hz: float = 0.0
    gain_trend_per_s: float = 0.0

    # --- chamber and supply
    chamber_leak_m2: float = 0.0
    critical_ratio: float = 0.0
    """Of ISO 6358's ellipse; 0: isentropic nozzle."""
    critical_shift: float = 0.0
    """Of the isentropic nozzle: where its unchoked branch begins."""
    regulator_pa_s_per_kg: float = 0.0
    tank_m3: float = 0.0
    fast_tank_share: float = 0.0
    """Share of the regulator's resistance before a second tank with a tenth of the time."""
    line_pa_s_per_kg: float = 0.0
    line_m3: float = 4e-6
    line_pa_s2_per_kg2: float = 0.0
    """Turbulent resistance, in air of the atmosphere's pressure."""
    dead_m3: float = 0.0
    hose_m3_per_pa: float = 0.0
    """A hose that swells under pressure."""
    polytropic: float = 1.0
    wall_heat_w_per_k: float = 0.0
    """Above 0 the gas has a temperature of its own, warmed through the wall."""
    ripple_pa: float = 0.0
    ripple_hz: float = 0.7
    ripple_rad: float = 0.0
    saw_pa: float = 0.0
    """A compressor refills the tank in jerks: from peak to peak, each `saw_s`."""
    saw_s: float = 1.0

    # --- mechanism
    bristle_n_per_m: float = 0.0
    bristle_n_s_per_m: float = 0.0
    slip_n_per_m: float = 0.0
    """Four Maxwell-slip elements of this stiffness together."""
    stribeck: float = 0.0
    stribeck_m_per_s: float = 5e-3
    stribeck_exponent: float = 2.0
    """2: Gaussian; 1: Tustin's exponential."""
    return_share: float = 0.0
    coulomb_n: float = 0.0
    dry_per_pa: float = 0.0
    dry_tilt: float = 0.0
    """Dry friction is greater forward and smaller back by this share; so the viscous one."""
    viscous_tilt: float = 0.0
    pressure_damping: float = 0.0
    stiffness_trend_per_s: float = 0.0
    cubic: float = 0.0
    creep_n_per_m: float = 0.0
    creep_s: float = 1.0
    creep_fast_share: float = 0.0
    """Share of the creep that has a tenth of the time: two branches look like a logarithm."""
    threshold_pa: float = 0.0
    stretch_per_pa: float = 0.0
    cap_m: float = 0.0
    load_n: float = 0.0
    piston_m2: float = 0.0
    mu_slope_per_m: float = 0.0
    mu_decay_per_s: float = 0.0
    mu_trend_per_s: float = 0.0
    mu_per_pa: float = 0.0
    braid_drag: float = 0.0
    """Share by which Eq. 5's damping of the braid differs; at -1 its friction is dry."""
    drag_per_m: float = 0.0
    """Viscous damping that grows along the stroke, N s/m for each m."""
    pull_per_m: float = 0.0
    """The pull changes along the stroke by this share."""
    stop_m: float = 0.0
    """Beyond it a second spring engages; 0: there is none."""
    stop_n_per_m: float = 0.0
    loop_n: float = 0.0
    """Half the force between loading and unloading of a hysteretic spring."""
    loop_m: float = 1e-3
    cog_n: float = 0.0
    """A periodic force over position; the rail's irregularity bends its period and its height."""
    cog_m: float = 5e-3
    rail_m: float = 17e-3
    grip_wave: float = 0.0
    """Share by which dry friction varies along the stroke."""
    grip_wave_m: float = 7e-3
    kink_m: float = 0.0
    """The spring is stiffer beyond it; 0: it is the same to either side."""
    kink_n_per_m: float = 0.0
    direct: float = 0.0
    """1: the force is given, and the muscle is only a mass on a spring with damping."""

    # --- sensors, as far as they have dynamics
    sensor_lag_s: float = 0.0
    backlash_m: float = 0.0


class State(NamedTuple):
    """Everything that the truth remembers. SI."""

    t_s: float
    play_v: float
    spool_v: float
    spool_rate: float
    air: float
    """P V^a of the muscle; with wall heat its mass times the gas constant."""
    gas_k: float
    line_air: float
    tank_pa: float
    fast_tank_pa: float
    """By how much the second tank is below the first."""
    pressure_pa: float
    line_pa: float
    x: float
    v: float
    bristle_n: float
    slip_1: float
    slip_2: float
    slip_3: float
    slip_4: float
    creep_slow_m: float
    creep_fast_m: float
    loop_n: float
    sensed_pa: float
    geared_m: float
