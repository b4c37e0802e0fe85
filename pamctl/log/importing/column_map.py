"""The map of an import, for files whose column names do not state quantity and unit.

    time: {column: Time, unit: ms}           # or {rate_hz: 1000} if there is no time column
    valve: {column: u, offset: -5.0}         # driver volts 0..10 to the command -5..5
    pressure: {column: P1, unit: kPa, gauge: true}
    position: {column: enc, unit: mm, gain: -1.0}

A value is (column x gain + offset), in the unit given. Beside the columns, a map may say what the
file does not: encoding, decimal mark, words for a missing value, the lines to import.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.configured import Configured
from pamctl.log.importing.quantities import (
    ATMOSPHERIC_PRESSURE_PA,
    TIME,
    UNITS,
    ColumnReading,
    TextHints,
)

Column = Annotated[
    Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=1)],
    Field(
        description="name in the file, or number from 1; for a column or a row of a matrix: "
        "yout(:,2) or yout(2,:)",
    ),
]
Gain = Annotated[float, Field(description="multiplies the column")]
Offset = Annotated[float, Field(description="added to column x gain, in the unit given here")]
Shift = Annotated[
    float,
    Field(
        ge=-10,
        le=10,
        description="added to the times of this column: negative where it was logged too late",
    ),
]
SensorNoise = Annotated[
    float | None,
    Field(ge=0, description="standard deviation of one reading, in the unit given here, if known"),
]


class TimeMap(Configured):
    """The time of a row."""

    column: Column | None = None
    unit: Literal["s", "ms", "us", "ns", "min"] = "s"
    rate_hz: Annotated[
        float | None, Field(gt=0, description="of the rows, if the file has no time column")
    ] = None

    @model_validator(mode="after")
    def _check_one_source(self) -> TimeMap:
        if (self.column is None) == (self.rate_hz is None):
            raise ValueError("give either a column or, if there is none, rate_hz")
        return self


class ValveMap(Configured):
    """The valve command as really applied, -5..5 V, positive fills."""

    column: Column
    unit: Literal["V", "mV"] = "V"
    gain: Gain = 1.0
    offset: Offset = 0.0
    shift_s: Shift = 0.0
    acts_after_s: Annotated[
        float,
        Field(
            ge=0,
            le=1,
            description="from a row's samples to the instant from which its command acts, where "
            "it is known: the loop's own time to compute and write",
        ),
    ] = 0.0


class PressureMap(Configured):
    """The pressure in the muscle."""

    column: Column
    unit: Literal[
        "Pa", "kPa", "MPa", "hPa", "bar", "mbar", "psi", "atm", "Torr", "mmHg", "inHg", "kgf/cm2"
    ]
    gauge: Annotated[bool, Field(description="relative to the atmosphere; else absolute")]
    gain: Gain = 1.0
    offset: Offset = 0.0
    shift_s: Shift = 0.0
    noise: SensorNoise = None


class PositionMap(Configured):
    """The displacement, positive in contraction."""

    column: Column
    unit: Literal["m", "mm", "cm", "um", "in"]
    gain: Gain = 1.0
    offset: Offset = 0.0
    shift_s: Shift = 0.0
    noise: SensorNoise = None


class ForceMap(Configured):
    """The pulling force at the muscle's end."""

    column: Column
    unit: Literal["N", "kN", "lbf", "kgf"] = "N"
    gain: Gain = 1.0
    offset: Offset = 0.0
    shift_s: Shift = 0.0
    noise: SensorNoise = None


class LinesMap(Configured):
    """A part of a file, by its line numbers, or by rows from 1 in a file without lines."""

    first: Annotated[int, Field(ge=1)] = 1
    last: Annotated[int | None, Field(ge=1)] = None


class ImportMap(Configured):
    """The columns of a measured file; quantities that were not measured are left out."""

    time: TimeMap
    valve: ValveMap | None = None
    pressure: PressureMap | None = None
    position: PositionMap | None = None
    force: ForceMap | None = None
    atmospheric_pressure_pa: Annotated[
        float,
        Field(
            gt=5e4, lt=1.2e5, description="pressure of the atmosphere, the zero of a gauge pressure"
        ),
    ] = ATMOSPHERIC_PRESSURE_PA
    encoding: Annotated[str | None, Field(description="of a text, such as cp1252 or shift_jis")] = (
        None
    )
    decimal: Annotated[Literal[".", ","] | None, Field(description="the mark of fractions")] = None
    date_order: Annotated[
        Literal["d/m/y", "m/d/y"] | None, Field(description="of dates such as 5/4/2026")
    ] = None
    missing: Annotated[
        tuple[str, ...], Field(description="cells that mean a missing value, beside the usual ones")
    ] = ()
    lines: Annotated[
        LinesMap | None, Field(description="the part of the file to import; else all of it")
    ] = None

    def hints(self) -> TextHints:
        """Return what the map says of a text's form."""
        return TextHints(
            self.encoding or "", self.decimal or "", self.missing, self.date_order or ""
        )

    def readings(self) -> list[ColumnReading]:
        """Return how to read each column; time comes first if there is a time column."""
        found = []
        if self.time.column is not None:
            found.append(ColumnReading(TIME, self.time.column, self.time.unit))
        parts = {
            "valve_v": self.valve,
            "pressure_pa": self.pressure,
            "position_m": self.position,
            "force_n": self.force,
        }
        for quantity, part in parts.items():
            if part is not None:
                reading = ColumnReading(
                    quantity, part.column, part.unit, part.gain, part.offset, shift_s=part.shift_s
                )
                if isinstance(part, PressureMap):
                    air_pa = self.atmospheric_pressure_pa
                    reading = replace(reading, gauge=part.gauge, atmospheric_pressure_pa=air_pa)
                found.append(reading)
        return found

    def stated_noise(self) -> dict[str, float]:
        """Return the noise that is stated, as standard deviations in SI by quantity."""
        parts = {"pressure_pa": self.pressure, "position_m": self.position, "force_n": self.force}
        return {
            quantity: part.noise * UNITS[quantity][part.unit]
            for quantity, part in parts.items()
            if part is not None and part.noise is not None
        }
