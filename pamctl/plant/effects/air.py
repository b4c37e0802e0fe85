"""Effects on the air: supply, lines, leaks and volumes."""

from __future__ import annotations

from math import exp, pi, pow, sin, sqrt
from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    Distinction,
    EffectDescription,
    EffectEntry,
    EffectForm,
    shape,
    size,
)


class ChamberLeak(NamedTuple):
    """Air leaks out of the muscle into the room."""

    area_m2: float = 0.0


CHAMBER_LEAK = EffectDescription(
    kind=ChamberLeak, block="pressure",
    equation="m -= A_c Psi(P, P_atm)",
    parameters=(
        size("area_m2", "m2", 3e-6, smallest=1e-9, start=1e-8, meaning="A_c, area of the leak"),
    ),
    signature="with the valve closed the pressure falls towards atmospheric pressure, faster at "
    "higher pressure",
    best_experiment="fill-and-hold", woven=("air",),
    told_from={
        "valve_leak": Distinction("fill-and-hold",
                                  "with the valve closed a valve leak ends between tank and "
                                    "atmosphere, a chamber leak at atmospheric pressure"),
    },
    as_terms=(
        AsTerm("flow", "gain", "pressure"),
        AsTerm("flow", "curve", "pressure"),
        AsTerm("leak", "onset", "time"),
        AsTerm("leak", "curve", "command"),
    ),
)  # fmt: skip


class DeadVolume(NamedTuple):
    """Constant air volume beside the muscle: tubes, fittings, the sensor's port."""

    volume_m3: float = 0.0


def add_dead_volume_m3(dead: DeadVolume, volume_m3: float) -> float:
    """Return the total volume."""
    return volume_m3 + dead.volume_m3


DEAD_VOLUME = EffectDescription(
    kind=DeadVolume, block="pressure",
    equation="V = V(x) + V_d",
    parameters=(
        size("volume_m3", "m3", 6e-4, smallest=1e-6, start=4e-6, meaning="V_d, added volume"),
    ),
    signature="the simulated pressure changes too fast, most where the volume is smallest",
    best_experiment="slow-ramps",
    entries=(EffectEntry("volume", add_dead_volume_m3),),
    same_as={"chamber": ("valve_gain_m2_per_v",), "cylinder": ("cylinder_volume_m3",)},
    as_terms=(AsTerm("volume", "constant"),),
)  # fmt: skip


class DischargeRatio(NamedTuple):
    """The valve chokes at a lower pressure ratio than a nozzle does (ISO 6358: b = 0.2 to 0.5)."""

    shift: float = 0.0


def nozzle_ratio(discharge: DischargeRatio, ratio: float, critical_ratio: float) -> float:
    """Return the pressure ratio at which an ideal nozzle would pass the same share of the flow.

    It stretches the unchoked branch, so that choking begins at `critical_ratio + shift` and the
    flow is still 0 at equal pressures. The result is within 0.3 % of ISO 6358's ellipse.
    """
    if discharge.shift == 0.0:
        return ratio
    span = (1.0 - critical_ratio) / (1.0 - critical_ratio - discharge.shift)
    return 1.0 - (1.0 - ratio) * span


DISCHARGE_RATIO = EffectDescription(
    kind=DischargeRatio, block="pressure",
    equation="Psi(r') with 1 - r' = (1 - r) (1 - C_r) / (1 - b),  b = C_r + shift",
    parameters=(
        size("shift", "1", 0.15, smallest=0.025, start=-0.1, meaning="b - C_r, C_r = 0.528",
             low=-0.4),
    ),
    signature="the flow is wrong while it is not choked: near the end of filling and of venting",
    best_experiment="square-1", woven=("air",),
)  # fmt: skip


class LineRestriction(NamedTuple):
    """A tube between valve and muscle, with resistance and volume; the sensor is at its valve end.

    The pressure at the sensor therefore leads the pressure in the muscle.

    Laminar and turbulent resistance of the tube, and its volume, lumped at the valve.
    """

    resistance_pa_s_per_kg: float = 0.0
    volume_m3: float = 0.0
    turbulent_pa_s2_per_kg2: float = 0.0
    """Pressure drop over the square of the flow, in air of atmospheric pressure."""


def restricts(line: LineRestriction) -> bool:
    """Tell whether the pressures at the two ends of the line differ."""
    return line.resistance_pa_s_per_kg > 0.0 or line.turbulent_pa_s2_per_kg2 > 0.0


def line_drop_pa(
    line: LineRestriction, flow_kg_per_s: float, end_pa: float, atmosphere_pa: float
) -> float:
    """Return by how much the valve's end is above the end at `end_pa`, for a flow into it.

    A turbulent isothermal flow in a pipe of constant friction loses P_1^2 - P^2 = 2 P_atm R_t g|g|.
    """
    drop_pa = line.resistance_pa_s_per_kg * flow_kg_per_s
    if line.turbulent_pa_s2_per_kg2 > 0.0:
        lost = 2.0 * atmosphere_pa * line.turbulent_pa_s2_per_kg2
        squared = end_pa * end_pa + lost * flow_kg_per_s * abs(flow_kg_per_s)
        drop_pa += sqrt(max(squared, 0.0)) - end_pa
    return drop_pa


def resistance_at_drop(
    line: LineRestriction, drop_pa: float, end_pa: float, atmosphere_pa: float
) -> float:
    """Return the drop over the flow, Pa s/kg, where the ends of the line differ by `drop_pa`."""
    if line.turbulent_pa_s2_per_kg2 <= 0.0:
        return line.resistance_pa_s_per_kg
    half = 0.5 * line.resistance_pa_s_per_kg
    middle_pa = max(end_pa + 0.5 * drop_pa, 1.0)
    turbulent = line.turbulent_pa_s2_per_kg2 * atmosphere_pa / middle_pa
    return half + sqrt(half * half + turbulent * abs(drop_pa))


def line_time_s(line: LineRestriction, specific_energy_j_per_kg: float) -> float:
    """Return the time constant of the line's own volume behind its laminar resistance."""
    return line.resistance_pa_s_per_kg * line.volume_m3 / specific_energy_j_per_kg


LINE_RESTRICTION = EffectDescription(
    kind=LineRestriction, block="pressure",
    equation="V_l P_1' = R T (m - g),  (P V)' = R T g,  the sensor sees P_1;  g = (P_1 - P) / "
    "R_l, or P_1 - P = R_l g + R_t g|g| P_atm / P_m",
    parameters=(
        size("resistance_pa_s_per_kg", "Pa s/kg", 5e8, smallest=1e6, start=5e6,
             meaning="R_l, resistance of the tube"),
        shape("volume_m3", "m3", 0.0, 2e-5, usual=0.0, smallest=1e-6,
              meaning="V_l, volume at the valve's end; it is filled through R_l alone"),
        size("turbulent_pa_s2_per_kg2", "Pa s2/kg2", 2e12, smallest=3e9, start=1.5e10,
             meaning="R_t, turbulent resistance at atmospheric pressure; P_m is the mean pressure"),
    ),
    signature="the measured pressure jumps with the flow, and the motion follows later; both "
    "blocks show it",
    best_experiment="square-1", seen_by=("pressure", "mechanics"), woven=("air",),
    forms=(
        EffectForm("resistance", free=("resistance_pa_s_per_kg",)),
        EffectForm("resistance and volume", free=("resistance_pa_s_per_kg", "volume_m3"),
                   held={"volume_m3": 3e-6}),
        EffectForm("turbulent", free=("resistance_pa_s_per_kg", "turbulent_pa_s2_per_kg2"),
                   held={"volume_m3": 0.0}),
    ),
    actuators=("muscle", "chamber", "cylinder"),
)  # fmt: skip


THINNEST = 1e-3
"""Less air than this share of that at rest has the walls' temperature at once."""
COLDEST, HOTTEST = 0.3, 3.0
"""Limits of T / T_0."""


class Polytropic(NamedTuple):
    """The air's temperature follows compression and flow: between isothermal and adiabatic.

    With a time of the walls the air takes their temperature again: a fast change is adiabatic, a
    slow one isothermal, and the pressure creeps after a fast one although no air flows. The walls
    take heat in proportion to the difference of temperature, whatever the volume: while a muscle
    contracts, its volume may double, and its surface, b^2 sin(2 theta) / (2 n), hardly changes.
    """

    exponent: float = 1.0
    wall_time_s: float = 0.0
    """Time in which the air of a vented muscle takes the walls' temperature; 0: it never does."""


class HeatShares(NamedTuple):
    """What the walls leave of the air's excess temperature in a step."""

    kept: float
    """Of that at the step's start, after the step."""
    caused: float
    """Of that which arises evenly during the step, at its end."""


def heat_shares(polytropic: Polytropic, mass: float, step_s: float) -> HeatShares:
    """Return the shares for this mass of air, over that of a vented muscle at rest.

    The time of the walls must be above 0.
    """
    if mass < THINNEST:  # a search may ask for what no rig does
        return HeatShares(0.0, 0.0)
    times = polytropic.wall_time_s * mass / step_s
    kept = exp(-1.0 / times)
    return HeatShares(kept, times * (1.0 - kept))


def polytropic_volume(exponent: float, volume_m3: float) -> float:
    """Return V^a; inflow adds to P V^a."""
    return volume_m3 if exponent == 1.0 else pow(volume_m3, exponent)


def polytropic_slope(exponent: float, volume_m3: float) -> float:
    """Return a V^(a-1), the slope of V^a."""
    return 1.0 if exponent == 1.0 else exponent * pow(volume_m3, exponent - 1.0)


def outflow_energy(warmth: float) -> float:
    """Return what air of T / T_0 carries away through an orifice, over that of air of T_0.

    The mass falls with the root of the temperature, and each kilogram carries R T.
    """
    return sqrt(warmth)


POLYTROPIC = EffectDescription(
    kind=Polytropic, block="pressure",
    equation="d(P V^a)/dt = a R T m V^(a-1); with walls T' also has -(T - T_0) / tau, tau = "
    "wall_time m / m_rest",
    parameters=(
        size("exponent", "1", 1.5, smallest=0.03, start=1.1,
             meaning="a: 1 isothermal, 1.4 adiabatic", neutral=1.0, low=1.0),
        shape("wall_time_s", "s", 0.0, 100.0, usual=0.0, smallest=0.02,
              meaning="time in which the air of a vented muscle takes the walls' heat; 0: never"),
    ),
    signature="the rate of pressure is wrong by one factor, under flow and under motion; with "
    "walls the pressure creeps after each fast change",
    best_experiment="square-1", woven=("air",),
    forms=(
        EffectForm("one exponent", free=("exponent",)),
        EffectForm("near walls", free=("exponent", "wall_time_s"),
                   held={"exponent": 1.35, "wall_time_s": 0.02}),
        EffectForm("far walls", free=("exponent", "wall_time_s"),
                   held={"exponent": 1.35, "wall_time_s": 0.5}),
    ),
)  # fmt: skip


FAST = 0.1
"""Time of the second tank over that of the first."""


class SupplyDroop(NamedTuple):
    """The supply's pressure falls while air is taken: a regulator with resistance, then a tank.

    A static droop without a refill time; otherwise a finite tank that the regulator fills.

    The tank's volume is refill_time R T / resistance.
    """

    resistance_pa_s_per_kg: float = 0.0
    refill_time_s: float = 0.0
    fast_share: float = 0.0
    """Share of the resistance in a second tank, at the valve, that refills ten times as fast."""


def kept_share(droop: SupplyDroop, step_s: float) -> float:
    """Return the share of a tank's present pressure that remains after `step_s` of refill."""
    return exp(-step_s / droop.refill_time_s) if droop.refill_time_s > 0.0 else 0.0


def kept_of_branch(droop: SupplyDroop, step_s: float) -> float:
    """Return the same share for the second, fast tank."""
    return exp(-step_s / (FAST * droop.refill_time_s)) if droop.refill_time_s > 0.0 else 0.0


def droop_resistance(droop: SupplyDroop, step_s: float) -> float:
    """Return by how much each kg/s lowers the supply after `step_s`, Pa s/kg."""
    slow = (1.0 - kept_share(droop, step_s)) * (1.0 - droop.fast_share)
    if droop.fast_share > 0.0:
        slow += (1.0 - kept_of_branch(droop, step_s)) * droop.fast_share
    return slow * droop.resistance_pa_s_per_kg


SUPPLY_DROOP = EffectDescription(
    kind=SupplyDroop, block="pressure",
    equation="tau P_s' = P_tank - R_s m - P_s,  m = flow out of the supply; static for tau = 0; "
    "two tanks: a share of R_s with tau / 10",
    parameters=(
        size("resistance_pa_s_per_kg", "Pa s/kg", 5e8, smallest=1e6, start=5e6,
             meaning="R_s, resistance of the regulator and its tube"),
        shape("refill_time_s", "s", 0.0, 5.0, usual=0.0, smallest=5e-3,
              meaning="tau = V_t R_s / (R T) of a tank of volume V_t between regulator and valve"),
        shape("fast_share", "1", 0.0, 1.0, usual=0.0, smallest=0.1,
              meaning="share of R_s behind a second tank, with a tenth of tau"),
    ),
    signature="an error while filling only, in proportion to the flow; a tank makes it last",
    best_experiment="square-1", woven=("air",),
    forms=(
        EffectForm("static", free=("resistance_pa_s_per_kg",)),
        EffectForm("finite tank", free=("resistance_pa_s_per_kg", "refill_time_s"),
                   held={"refill_time_s": 0.05}),
        EffectForm("two tanks", free=("resistance_pa_s_per_kg", "refill_time_s", "fast_share"),
                   held={"refill_time_s": 0.1, "fast_share": 0.4}),
    ),
    as_terms=(AsTerm("supply", "curve", "time"),),
)  # fmt: skip


HIGHEST_HZ = 50.0


class SupplyRipple(NamedTuple):
    """The supply's pressure swings: a compressor that starts and stops, a regulator that hunts."""

    amplitude_pa: float = 0.0
    frequency_hz: float = 1.0
    phase_rad: float = 0.0


def ripple_pa(ripple: SupplyRipple, age_s: float) -> float:
    """Return what the ripple adds to the supply's pressure."""
    if ripple.amplitude_pa == 0.0:
        return 0.0
    return ripple.amplitude_pa * sin(2.0 * pi * ripple.frequency_hz * age_s + ripple.phase_rad)


SUPPLY_RIPPLE = EffectDescription(
    kind=SupplyRipple, block="pressure",
    equation="P_s = P_tank + a sin(2 pi f t + phi)",
    parameters=(
        size("amplitude_pa", "Pa", 100e3, smallest=1.7e3, start=5e3, meaning="a"),
        shape("frequency_hz", "Hz", 0.02, HIGHEST_HZ, usual=1.0, smallest=0.01, meaning="f"),
        shape("phase_rad", "rad", -2.0 * pi, 2.0 * pi, usual=0.0, smallest=0.1,
              meaning="phi, at the start of a record"),
    ),
    signature="an error while filling that comes and goes at a rhythm of its own",
    best_experiment="square-1", woven=("air",),
    as_terms=(AsTerm("supply", "wave", "time"),),
)  # fmt: skip
