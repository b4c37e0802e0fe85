"""A rig file for a plant: the shipped file of a backend, with limits that suit what moves.

The shipped files have the limits of the paper's muscle. A larger muscle, or a cylinder, would trip
there at once. What follows from a plant file is put in: pressures from the supply, stroke and speed
from a simulated fill with the valve fully open. What depends on sensors and cards stays as it is,
but for a simulated sensor, which gets the range that it needs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from hal.backend import get_backend
from hal.calibration import CalibrationSettings
from pamctl.commissioning.guided import RigValue, insert_values
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.safety import LimitSettings
from pamctl.settings.config_files import find_config_file
from pamctl.settings.resolve import read_section_file, require_drivable

ABOVE_SPEED = 2.0
"""The speed limit over the fastest motion: a faster one is an error of the encoder."""
ABOVE_SUPPLY = 1.1
"""The pressure limit over the supply's pressure: noise and a sensor's error stay below it."""
MODEL_SHARE = 0.18
"""How far pressure and model may part, over the supply's pressure; as on the paper's rig."""
BEYOND_STROKE = 0.1
"""The stroke's limits lie this share of the stroke outside it."""
ERROR_SHARE = 0.16
"""The largest tracking error over the stroke; as on the paper's rig."""
SENSOR_TOP_V = 4.5
"""A simulated sensor shows the limit of the pressure here."""
_AXIS = "axis"
"""The shipped file of an axis's drive, whose safe voltage is no force."""
HELD_S, TICK_S = 4.0, 1e-3
"""How long the valve is open, and the step of the simulated record."""


def make_rig_file(plant: PlantSettings, name: str, backend: str) -> tuple[str, list[str]]:
    """Return the text of a rig file that suits a plant, and what is still to be checked.

    `name` is the plant file's name, for the comments. Raises ValueError for a plant that no law
    can move, and `ConfigError` where the backend's shipped file cannot be read.
    """
    require_drivable(plant)
    record = get_backend(backend)
    is_axis = plant.actuator == "direct"
    shipped = _AXIS if is_axis and record.is_simulated else record.rig_file
    source = find_config_file("rig", shipped)
    rig = read_section_file("rig", source)
    notes = list(_list_checks(is_axis, record.is_simulated))
    values: list[RigValue] = []
    if not is_axis:
        limit_pa = _bound("pressure_pa", ABOVE_SUPPLY * plant_parameters(plant).tank_pressure_pa)
        values += _suit_limits(plant, rig.limits, limit_pa)
        if not _shows(rig.calibration, rig.limits, limit_pa):
            if record.is_simulated:
                values.append(_suit_sensor(rig.calibration, limit_pa))
            else:
                notes.append(
                    f"the sensor of the shipped file cannot show {limit_pa * 1e-3:.0f} kPa: "
                    "put yours under calibration.sensor_pa_per_v"
                )
    today = datetime.now(UTC).strftime("%Y-%m-%d")
    heading = f"{today} pamctl plant rig: limits for {name}, from the shipped file {source.name}"
    return insert_values(source.read_text(encoding="utf-8"), values, (heading, *notes)), notes


def _list_checks(is_axis: bool, is_simulated: bool) -> Iterator[str]:
    """Yield what no plant file says."""
    if is_axis:
        yield "a plant file has no stroke of an axis: check limits.stroke_low_mm and stroke_high_mm"
    if not is_simulated:
        yield "check device, channels and safe_volts, then run `pamctl doctor`"


def _suit_limits(plant: PlantSettings, limits: LimitSettings, limit_pa: float) -> list[RigValue]:
    """Return the limits of what a supply fills; a speed limit is not made lower."""
    reach = simulate_reach(plant, limits.command_v)
    speed_mm_per_s = max(ABOVE_SPEED * reach.fastest_m_per_s * 1e3, limits.speed_mm_per_s)
    tank_pa = plant_parameters(plant).tank_pressure_pa
    stroke_mm = reach.highest_m * 1e3
    fill = "of a simulated fill at the full command"
    beyond = f"{BEYOND_STROKE:g} of the stroke beyond both ends {fill}"
    rows = (
        ("pressure_pa", limit_pa, "Pa", "from the supply's pressure"),
        ("pressure_model_pa", MODEL_SHARE * tank_pa, "Pa", "from the supply's pressure"),
        ("stroke_low_mm", -BEYOND_STROKE * stroke_mm, "mm", beyond),
        ("stroke_high_mm", (1.0 + BEYOND_STROKE) * stroke_mm, "mm", beyond),
        ("speed_mm_per_s", speed_mm_per_s, "mm/s", f"{ABOVE_SPEED:g} times the fastest {fill}"),
        ("tracking_error_mm", ERROR_SHARE * stroke_mm, "mm", f"{ERROR_SHARE:g} of that stroke"),
    )
    return [
        RigValue(("limits", key), _bound(key, value), unit, 0.0, how)
        for key, value, unit, how in rows
    ]


def _bound(key: str, value: float) -> float:
    """Return three digits of a limit, within what the settings take."""
    rules = LimitSettings.model_fields[key].metadata
    low = max((rule.ge for rule in rules if hasattr(rule, "ge")), default=-math.inf)
    high = min((rule.le for rule in rules if hasattr(rule, "le")), default=math.inf)
    return float(f"{min(max(value, low), high):.3g}")


def _shows(calibration: CalibrationSettings, limits: LimitSettings, pressure_pa: float) -> bool:
    gauge_pa = pressure_pa - calibration.atmospheric_pressure_pa
    return calibration.sensor_zero_v + gauge_pa / calibration.sensor_pa_per_v < limits.sensor_high_v


def _suit_sensor(calibration: CalibrationSettings, limit_pa: float) -> RigValue:
    gauge_pa = limit_pa - calibration.atmospheric_pressure_pa
    slope = float(f"{gauge_pa / (SENSOR_TOP_V - calibration.sensor_zero_v):.4g}")
    how = "a simulated sensor that shows the limit of the pressure"
    return RigValue(("calibration", "sensor_pa_per_v"), slope, "Pa/V", 0.0, how)


def advise_after_trip(plant: PlantSettings, limits: LimitSettings) -> str:
    """Return what to do where a plant can leave limits that were made for another; or nothing."""
    if plant.actuator == "direct":
        return ""
    tank_pa = plant_parameters(plant).tank_pressure_pa
    reach = simulate_reach(plant, limits.command_v)
    beyond = [
        name
        for name, most, limit in (
            ("limits.pressure_pa", tank_pa, limits.pressure_pa),
            ("limits.stroke_high_mm", reach.highest_m * 1e3, limits.stroke_high_mm),
            ("limits.speed_mm_per_s", reach.fastest_m_per_s * 1e3, limits.speed_mm_per_s),
        )
        if most > limit
    ]
    if not beyond:
        return ""
    return (
        f"the plant can go beyond {', '.join(beyond)} of the rig file; "
        "`pamctl plant rig PLANT.yaml RIG.yaml` writes a rig file with limits that suit it"
    )


class Reach(NamedTuple):
    """What a plant does when its valve is opened fully, and then vents."""

    highest_m: float
    fastest_m_per_s: float


def simulate_reach(plant: PlantSettings, command_v: float) -> Reach:
    """Simulate a fill at the full command, then a vent."""
    held = round(HELD_S / TICK_S)
    commands_v = np.repeat([command_v, -command_v], held)
    position_m = drive_coupled(plant_parameters(plant), commands_v, TICK_S).position_m
    fastest = float(np.abs(np.diff(position_m)).max()) / TICK_S
    return Reach(float(position_m.max()), fastest)
