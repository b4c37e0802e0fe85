"""The map of an import, for files whose column names do not state quantity and unit.

    time: {column: Time, unit: ms}           # or {rate_hz: 1000} if there is no time column
    valve: {column: u, offset: -5.0}         # driver volts 0..10 to the command -5..5
    pressure: {column: P1, unit: kPa, gauge: true}
    position: {column: enc, unit: mm, gain: -1.0}

A value is (column x gain + offset), in the unit given.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from hal.configured import Configured
from pamctl.log.importing.quantities import (
    ATMOSPHERIC_PRESSURE_PA,
    TIME,
    UNITS,
    ColumnReading,
)


def _spell_number(column: object) -> object:
    return str(column) if type(column) is int else column


Column = Annotated[
    str,
    BeforeValidator(_spell_number),
    Field(
        min_length=1,
        description="name in the file; its number from 1 where the file has no line of names; "
        "for a column of a MAT matrix: yout(:,2)",
    ),
]
Gain = Annotated[float, Field(description="multiplies the column")]
Offset = Annotated[float, Field(description="added to column x gain, in the unit given here")]
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
    unit: Literal["Pa", "kPa", "MPa", "bar", "mbar", "psi"]
    gauge: Annotated[bool, Field(description="relative to the atmosphere; else absolute")]
    gain: Gain = 1.0
    offset: Offset = 0.0
    noise: SensorNoise = None


class PositionMap(Configured):
    """The displacement, positive in contraction."""

    column: Column
    unit: Literal["m", "mm", "cm", "um", "in"]
    gain: Gain = 1.0
    offset: Offset = 0.0
    noise: SensorNoise = None


class ForceMap(Configured):
    """The pulling force at the muscle's end."""

    column: Column
    unit: Literal["N", "kN"] = "N"
    gain: Gain = 1.0
    offset: Offset = 0.0
    noise: SensorNoise = None


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

    def readings(self) -> list[ColumnReading]:
        """Return how to read each column; time comes first if there is a time column."""
        found = []
        if self.time.column is not None:
            found.append(ColumnReading(TIME, self.time.column, self.time.unit))
        for quantity, part in (
            ("valve_v", self.valve),
            ("position_m", self.position),
            ("force_n", self.force),
        ):
            if part is not None:
                found.append(
                    ColumnReading(quantity, part.column, part.unit, part.gain, part.offset)
                )
        if (p := self.pressure) is not None:
            place = (p.column, p.unit, p.gain, p.offset, p.gauge, self.atmospheric_pressure_pa)
            found.append(ColumnReading("pressure_pa", *place))
        return found

    def stated_noise(self) -> dict[str, float]:
        """Return the noise that is stated, as standard deviations in SI by quantity."""
        parts = {"pressure_pa": self.pressure, "position_m": self.position, "force_n": self.force}
        return {
            quantity: part.noise * UNITS[quantity][part.unit]
            for quantity, part in parts.items()
            if part is not None and part.noise is not None
        }
