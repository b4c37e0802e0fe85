"""The quantities and units of columns: the suffix of a name states both."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

from hal.calibration import CalibrationSettings
from pamctl.units import find_units

ATMOSPHERIC_PRESSURE_PA = CalibrationSettings().atmospheric_pressure_pa

TIME = "t_s"
QUANTITIES = (TIME, "valve_v", "pressure_pa", "position_m", "force_n")
UNITS: Mapping[str, Mapping[str, float]] = {name: find_units(name) for name in QUANTITIES}
"""SI value of each unit of a quantity."""

_WORDS = {
    "t": TIME,
    "time": TIME,
    "valve": "valve_v",
    "pressure": "pressure_pa",
    "pressure_gauge": "pressure_pa",
    "pressure_absolute": "pressure_pa",
    "position": "position_m",
    "displacement": "position_m",
    "force": "force_n",
}
_NAME = re.compile(rf"({'|'.join(sorted(_WORDS, key=len, reverse=True))})_([a-z]+)")


class SaidQuantity(NamedTuple):
    """What a name, or a unit beside it, says of a column."""

    quantity: str
    unit: str
    is_gauge: bool | None
    """Of a pressure; None where nothing says it."""


def parse_column_name(name: str) -> SaidQuantity | None:
    """Return what a name such as `position_mm` states; None if it does not state it so."""
    match = _NAME.fullmatch(name.strip().lower())
    if match is None:
        return None
    word, suffix = match.groups()
    quantity = _WORDS[word]
    unit = next((unit for unit in UNITS[quantity] if unit.lower() == suffix), None)
    is_gauge = word == "pressure_gauge" if quantity == "pressure_pa" else None
    return None if unit is None else SaidQuantity(quantity, unit, is_gauge)
