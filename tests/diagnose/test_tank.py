"""What a tank lacks beside its plant file: heat to the walls, another valve, a weaker exhaust."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.made_records import numbers_of

from pamctl.diagnose import Diagnosis, Record, diagnose
from pamctl.plant.model import PlantSettings

pytestmark = pytest.mark.long

RATE_HZ, SAMPLES, OPEN_V = 100.0, 800, 5.0
R, C_P, T_0 = 287.05, 1004.5, 294.15
C_V = C_P - R
VOLUME_M3, SUPPLY_PA, ROOM_PA = 2e-3, 6.1e5, 100.2e3
CONDUCTANCE, VENTING, CRITICAL, WALLS_W_PER_K = 2e-8, 0.9, 0.32, 1.2
"""Sonic conductance, m3/(s Pa), venting's share of it, critical ratio, heat to the walls."""


def nozzle_kg_per_s(before_pa: float, before_k: float, behind_pa: float) -> float:
    """ISO 6358: an ellipse below the choked flow."""
    if behind_pa >= before_pa:
        return 0.0
    over = max(behind_pa / before_pa - CRITICAL, 0.0) / (1.0 - CRITICAL)
    choked = CONDUCTANCE * 1.185 * before_pa * np.sqrt(293.15 / before_k)
    return float(choked * np.sqrt(1.0 - over**2))


def draw_switching_v(seed: int) -> np.ndarray:
    random, command_v = np.random.default_rng(seed), np.zeros(SAMPLES)
    k = int(0.5 * RATE_HZ)
    while k < SAMPLES:
        opened = int(random.uniform(0.15, 0.6) * RATE_HZ)
        command_v[k : k + opened] = random.choice([OPEN_V, -OPEN_V], p=[0.55, 0.45])
        k += opened + int(random.uniform(0.3, 1.5) * RATE_HZ)
    return command_v


@cache
def record_tank(seed: int) -> Record:
    command_v, tick_s = draw_switching_v(seed), 1.0 / RATE_HZ
    states = np.empty((SAMPLES, 2))
    states[0] = ROOM_PA * VOLUME_M3 / (R * T_0), T_0
    for k in range(SAMPLES - 1):

        def rates(t_s: float, state: np.ndarray, valve_v: float = command_v[k]) -> list[float]:
            kg, kelvin = state
            pressure_pa = kg * R * kelvin / VOLUME_M3
            came = nozzle_kg_per_s(SUPPLY_PA, T_0, pressure_pa) if valve_v > 0.0 else 0.0
            went = nozzle_kg_per_s(pressure_pa, kelvin, ROOM_PA) if valve_v < 0.0 else 0.0
            went *= VENTING
            heat = came * (C_P * T_0 - C_V * kelvin) - went * R * kelvin
            heat += WALLS_W_PER_K * (T_0 - kelvin)
            return [came - went, heat / (kg * C_V)]

        states[k + 1] = solve_ivp(rates, (0.0, tick_s), states[k], rtol=1e-7, atol=1e-9).y[:, -1]
    pressure_pa = states[:, 0] * R * states[:, 1] / VOLUME_M3
    noisy_pa = pressure_pa + np.random.default_rng(seed + 99).normal(0.0, 150.0, SAMPLES)
    return Record(
        name=f"tank{seed}",
        t_s=np.arange(SAMPLES) * tick_s,
        valve_v=command_v,
        pressure_pa=np.round(noisy_pa / 61.0) * 61.0,
    )


@cache
def diagnose_tank() -> Diagnosis:
    plant = PlantSettings.model_validate(
        {
            "actuator": "chamber",
            "chamber_volume_m3": VOLUME_M3,
            "parameters": {
                "atmospheric_pressure_pa": 101.3e3,
                "tank_pressure_pa": 6e5,
                "temperature_k": 293.0,
                "valve_gain_m2_per_v": 1e-6,
            },
        }
    )
    return diagnose([record_tank(3)], [record_tank(4)], plant)


def test_three_effects_of_a_tank_that_hide_behind_each_other_are_found_together():
    found = diagnose_tank()
    values = numbers_of(found)
    assert found.gap["pressure_pa"].extended < 1.5 * found.gap["pressure_pa"].floor
    assert values["polytropic.exponent"] == pytest.approx(1.4, abs=0.02)
    assert 0.528 + values["discharge_ratio.shift"] == pytest.approx(CRITICAL, abs=0.03)


def test_an_on_off_valve_cannot_tell_a_dead_band_from_a_weaker_exhaust():
    found = diagnose_tank()
    (valve,) = (f for f in found.findings if f.hypothesis.place == "valve")
    assert valve.level == "place"
    names = {valve.name, *(rival.name for rival in valve.rivals)}
    assert {"valve_deadband", "valve_asymmetry"} <= names
    values = numbers_of(found)
    opens_v = OPEN_V - values.get("valve_deadband.exhaust_width_v", 0.0)
    share = values.get("valve_asymmetry.exhaust_gain", opens_v / OPEN_V)
    assert share == pytest.approx(VENTING, abs=0.01)
