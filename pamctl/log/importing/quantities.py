"""The quantities and units of columns: the suffix of a name states both."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hal.calibration import CalibrationSettings
from pamctl.units import find_units

if TYPE_CHECKING:  # settings import the map, and the loop process must not load numpy
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

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


@dataclass(frozen=True)
class ColumnReading:
    """How a column of the source becomes a column of the log."""

    quantity: str
    column: str | int
    """Its name, or its number from 1."""
    unit: str
    gain: float = 1.0
    offset: float = 0.0
    """Added to column x gain, in `unit`."""
    gauge: bool = False
    """Whether the pressure is relative to the atmosphere."""
    atmospheric_pressure_pa: float = ATMOSPHERIC_PRESSURE_PA
    shift_s: float = 0.0
    """Added to the times of this column's samples: negative where it was logged too late."""

    def to_si(self, raw: Floats) -> Floats:
        """Return the quantity in SI, pressure absolute, for a column of shape (n,)."""
        value = UNITS[self.quantity][self.unit] * (self.gain * raw + self.offset)
        return value + self.atmospheric_pressure_pa if self.gauge else value


@dataclass(frozen=True)
class TextHints:
    """What the user says of a file of text; nothing said is found in the file."""

    encoding: str = ""
    decimal: str = ""
    missing: tuple[str, ...] = ()
    """Words for a missing value, beside the usual ones."""
    date_order: str = ""
    """`d/m/y` or `m/d/y`."""


def parse_column_name(column: str, name: str = "") -> ColumnReading | None:
    """Return how to read a column, from its name; None if the name does not state it.

    `name` replaces the column's own name, if given.
    """
    match = _NAME.fullmatch((name or column).strip().lower())
    if match is None:
        return None
    word, suffix = match.groups()
    quantity = _WORDS[word]
    unit = next((unit for unit in UNITS[quantity] if unit.lower() == suffix), None)
    if unit is None:
        return None
    return ColumnReading(quantity, column, unit, gauge=word == "pressure_gauge")
