"""SMC: the sliding mode law of Eq. 16 and 18, which linearises the muscle by its model.

f-hat and g-hat
---------------
Differentiate the second row of Eq. 9 once, with A(x) = dV/dx of Eq. 3, the gauge
pressure P_g, m = mu_k N A_b, and B(x) = b theta cos(theta) of Eq. 5:

    M x'' = P_g A - k x - c x' - [x' > 0] m P_g (B + x')
    M x''' = P' (A - [x' > 0] m (B + x'))
             + x' (P_g A' - k - [x' > 0] m P_g B') - x'' (c + [x' > 0] m P_g)

    A' = dA/dx = -6 L / (4 pi n^2)
    B' = dB/dx = -arccos(L / b) + L / sqrt(b^2 - L^2)

and put in P' = (R T K_Av Psi / V) u - P A x' / V (Eq. 8, V' = A x'). What multiplies u
is g; the rest is the drift, and f-hat of the paper is minus the drift:

    x''' = -f + g u,  so that  u = (x''' + f) / g.

g depends on the side that the valve opens to: the sign of the wanted x''' + f decides which
Psi is used. P is measured; x' and x'' are those of the reference plus the
filtered derivatives of the error. With M = 0.05 kg g is about 4e4 m/s^3/V
where the vented muscle is filled, and a quarter of it where a filled one exhausts.

The mass is a gain
------------------
At rest the law amounts to

    u = -K_p / g ((3 l - c / M) e'' + (3 l^2 - d / M) e' + l^3 e),    c = 570 N s/m, d = 1.6e4 N/m,

because f-hat cancels the muscle's own damping and stiffness. With the 0.05 kg of Table I c / M is
1e4 1/s: any lambda below 3800 1/s feeds the acceleration back with the wrong sign, any below
320 1/s the velocity too, and a late valve makes that an oscillation. The moved mass acts within
0.1 ms, so no rig can ever measure it. For the law it is a gain, and `pamctl tune` seeks it as one.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field

from pamctl.control.law import GainAxis, Law, SearchSpace, read_numbers
from pamctl.control.sliding import (
    FIXED_SLIDING,
    LPF1_BOUNDS,
    LPF2_BOUNDS,
    REACHING_AXES,
    SLIDING_BLENDED,
    SLIDING_TERMS,
    STIFFNESS_BOUNDS,
    Absement,
    SlidingGains,
    SlidingSettings,
    clamp_value,
    prevent_windup,
    reaching_term,
    sliding_gains,
    sliding_gains_at,
    sliding_numbers_of,
)
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.paper import (
    PaperParameters,
    braid_lever_m,
    force_area_m2,
    orifice_flow,
    volume_m3,
)
from pamctl.signals import Command, Estimate, Reference


class SmcSettings(SlidingSettings):
    """Eq. 16; with q = 1 Eq. 18."""

    law: Literal["smc"]
    kp: Annotated[float, Field(gt=0, description="K_p of Eq. 16, without unit")]
    model: Annotated[PlantSettings, Field(description="plant that f-hat and g-hat are made of")] = (
        PlantSettings()
    )


class SmcGains(NamedTuple):
    """Gains of Eq. 16 for the kernel."""

    sliding: SlidingGains
    kp: float
    model: PaperParameters


class Linearisation(NamedTuple):
    """x''' = drift + gain u, of the model; m/s^3 and m/s^3/V."""

    drift_m_per_s3: float
    fill_gain: float
    exhaust_gain: float


def smc_gains(settings: SmcSettings) -> SmcGains:
    """Turn settings into the numbers that the kernel uses."""
    return SmcGains(sliding_gains(settings), settings.kp, plant_parameters(settings.model).paper)


def linearise_model(
    p: PaperParameters, x: float, velocity: float, acceleration: float, pressure_pa: float
) -> Linearisation:
    """x''' of the model at (x, x', x'', P), split as the module's docstring derives it."""
    # Beyond these the braid has no length. The encoder is wrong then, and safety trips.
    lowest_m = p.rest_length_m - _LONGEST * p.braid_length_m
    highest_m = p.rest_length_m - _SHORTEST * p.braid_length_m
    if x < lowest_m:
        x = lowest_m
    elif x > highest_m:
        x = highest_m
    length = p.rest_length_m - x
    gauge = pressure_pa - p.atmospheric_pressure_pa
    area, volume = force_area_m2(p, x), volume_m3(p, x)
    grip = p.friction_area_m if velocity > 0.0 else 0.0
    lever_slope = length / math.sqrt(p.braid_length_m**2 - length * length) - math.acos(
        length / p.braid_length_m
    )
    area_slope = -6.0 * length * p.volume_scale

    per_pressure_rate = area - grip * (braid_lever_m(p, x) + velocity)
    drift = (
        -per_pressure_rate * pressure_pa * area * velocity / volume
        + velocity * (gauge * (area_slope - grip * lever_slope) - p.stiffness_n_per_m)
        - acceleration * (p.damping_n_s_per_m + grip * gauge)
    ) / p.mass_kg
    per_flow = (
        per_pressure_rate
        * p.specific_energy_j_per_kg
        * p.valve_gain_m2_per_v
        / (volume * p.mass_kg)
    )
    tank, atmosphere = p.tank_pressure_pa, p.atmospheric_pressure_pa
    return Linearisation(
        drift,
        per_flow * orifice_flow(p, tank, min(pressure_pa, _MOST_BALANCED * tank)),
        per_flow * orifice_flow(p, max(pressure_pa, atmosphere / _MOST_BALANCED), atmosphere),
    )


# As shares of the braid's length: at 1 it is stretched, at 0.577 it has no force (Eq. 3).
_LONGEST, _SHORTEST = 0.99, 0.6

# At balanced pressures the valve moves no air, and g-hat would be 0. The flow is therefore never
# taken to be less than at this ratio of pressures.
_MOST_BALANCED = 0.98


def smc(
    gains: SmcGains, memory: Absement, reference: Reference, estimate: Estimate, dt_s: float
) -> tuple[Command, Absement]:
    """u = K_p / g (x_D''' + f - 3 l e'' - 3 l^2 e' - l^3 e - u_rb), l = lambda^q (Eq. 16)."""
    g = gains.sliding
    scale, pole = g.units_per_m, g.pole_per_s
    e = estimate.error_m
    rate = estimate.error_rate_m_per_s
    acceleration = estimate.error_acceleration_m_per_s2
    absement_m_s = memory.absement_m_s + e * dt_s

    s = acceleration + pole * (3.0 * rate + pole * (3.0 * e + pole * absement_m_s))
    error_drift = pole * (3.0 * acceleration + pole * (3.0 * rate + pole * e))
    reach = reaching_term(g.literal_reaching, g.eta, g.phi, s * scale) / scale
    model = linearise_model(
        gains.model,
        estimate.position_filtered_m,
        reference.reference_velocity_m_per_s + rate,
        reference.reference_acceleration_m_per_s2 + acceleration,
        estimate.pressure_estimate_pa,
    )
    wanted_jerk = reference.reference_jerk_m_per_s3 - model.drift_m_per_s3 - error_drift - reach
    gain = model.fill_gain if wanted_jerk > 0.0 else model.exhaust_gain

    wanted_v = gains.kp / gain * wanted_jerk
    command_v = clamp_value(wanted_v, g.limit_v)
    robust_v = -gains.kp / gain * reach
    return (
        Command(command_v, s, wanted_v - robust_v, robust_v, command_v != wanted_v),
        prevent_windup(memory, absement_m_s, e, wanted_v - command_v),
    )


def _make_search_terms(mass_kg: float) -> tuple[float, str, float]:
    """Return q, K_p's name, and g-hat with this mass: resting, half filled, at mid-stroke."""
    p = plant_parameters(PlantSettings()).paper._replace(mass_kg=mass_kg)
    half_filled_pa = 0.5 * (p.tank_pressure_pa + p.atmospheric_pressure_pa)
    return 1.0, "kp", 1e3 * linearise_model(p, 11.8e-3, 0.0, 0.0, half_filled_pa).fill_gain


def _to_gains(numbers: dict[str, float]) -> dict[str, Any]:
    mass_kg = numbers["model_mass_kg"]
    model = {"parameters": {"mass_kg": mass_kg}}
    return {**sliding_gains_at(numbers, *_make_search_terms(mass_kg)), "model": model}


def _from_gains(gains: dict[str, Any]) -> dict[str, float]:
    parameters = gains["model"].get("parameters", {})
    mass_kg = float(parameters.get("mass_kg", PlantSettings().parameters.mass_kg))
    return {
        **sliding_numbers_of(read_numbers(gains), *_make_search_terms(mass_kg)),
        "model_mass_kg": mass_kg,
    }


LAW = Law(
    name="smc",
    title="SMC",
    equation="u = K_p / g (x_D''' + f - 3 l e'' - 3 l^2 e' - l^3 e - u_rb), l = lambda^q "
    "(Eq. 16; with q = 1 Eq. 18)",
    settings=SmcSettings,
    gains=SmcGains,
    to_gains=smc_gains,
    kernel=smc,
    armed=Absement(0.0),
    terms=SLIDING_TERMS,
    blended=SLIDING_BLENDED | {"kp", "model"},
    search=SearchSpace(
        fixed={"law": "smc", **FIXED_SLIDING, "q": 1.0},
        axes=(
            GainAxis("lambda_per_s", 20.0, 3000.0, 250.0),
            GainAxis("stiffness_v_per_mm", *STIFFNESS_BOUNDS, 15.0),
            GainAxis("model_mass_kg", 0.05, 20.0, 1.5),
            *REACHING_AXES,
            GainAxis("lpf1_hz", *LPF1_BOUNDS, 300.0),
            GainAxis("lpf2_hz", *LPF2_BOUNDS, 430.0),
        ),
        to_gains=_to_gains,
        from_gains=_from_gains,
    ),
)
