"""The map of an import, for files whose column names do not state quantity and unit.

    time: {column: Time, unit: ms}           # or {rate_hz: 1000} if there is no time column
    valve: {column: u, offset: -5.0}         # driver volts 0..10 to the command -5..5
    pressure: {column: P1, unit: kPa, gauge: true}
    position: {column: enc, unit: mm, gain: -1.0}

A value is (column x gain + offset), in the unit given. Beside the columns, a map may say what the
file does not: encoding, decimal mark, words for a missing value, the lines to import. A name such
as `position_mm` states quantity and unit itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from hal.calibration import CalibrationSettings, Configured
from pamctl.base.texts import to_json
from pamctl.log.importing.headers import TIME, UNITS, explain_angle, read_unit

if TYPE_CHECKING:
    from pamctl.log.importing.measured_table import Floats


ATMOSPHERIC_PRESSURE_PA = CalibrationSettings().atmospheric_pressure_pa


Column = Annotated[
    Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=1)],
    Field(
        description="name in the file, or number from 1; for a column or a row of a matrix: "
        "yout(:,2) or yout(2,:)",
    ),
]
SensorNoise = Annotated[
    float | None,
    Field(ge=0, description="standard deviation of one reading, in the unit given here, if known"),
]


class _PartMap(Configured):
    quantity: ClassVar[str]

    @model_validator(mode="before")
    @classmethod
    def _read_unit(cls, keys: Any) -> Any:
        """Read a unit as in a header: `psig` is psi and gauge, `inches` are in."""
        said = read_unit(str(keys.get("unit"))) if isinstance(keys, dict) else None
        if said is None or said.quantity != cls.quantity:
            return keys
        if said.is_gauge is None:
            return {**keys, "unit": said.unit}
        if keys.get("gauge", said.is_gauge) is not said.is_gauge:
            raise ValueError(f"unit: {keys['unit']} contradicts gauge: {keys['gauge']}")
        return {**keys, "unit": said.unit, "gauge": said.is_gauge}


class TimeMap(_PartMap):
    """The time of a row."""

    quantity: ClassVar[str] = TIME
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


class _MeasuredMap(_PartMap):
    column: Column
    gain: Annotated[float, Field(description="multiplies the column")] = 1.0
    offset: Annotated[
        float, Field(description="added to column x gain, in the unit given here")
    ] = 0.0
    shift_s: Annotated[
        float,
        Field(
            ge=-10,
            le=10,
            description="added to the times of this column: negative where it was logged too late",
        ),
    ] = 0.0

    @field_validator("unit", mode="before", check_fields=False)
    @classmethod
    def _refuse_other_kind(cls, unit: object) -> object:
        """Say how a column of another kind, such as a current or an angle, becomes this one."""
        known = UNITS[cls.quantity]
        if not isinstance(unit, str) or unit in known:
            return unit
        if cls.quantity == "position_m" and (angle := explain_angle(unit)):
            raise ValueError(f"{unit} is {angle}")
        si = next(iter(known))
        example = ""
        if cls.quantity == "valve_v" and unit == "mA":
            example = ", such as `unit: V, gain: 0.625, offset: -7.5` for 4 to 20 mA"
        raise ValueError(
            f"{unit} is none of {', '.join(known)}: is it a slip, or of another kind? Then write "
            f"`unit: {si}, gain: G, offset: O`, where G x column + O is in {si}{example}"
        )


class ValveMap(_MeasuredMap):
    """The valve command as really applied, -5..5 V, positive fills."""

    quantity: ClassVar[str] = "valve_v"
    unit: Literal["V", "mV"] = "V"
    acts_after_s: Annotated[
        float,
        Field(
            ge=0,
            le=1,
            description="from a row's samples to the instant from which its command acts, where "
            "it is known: the loop's own time to compute and write",
        ),
    ] = 0.0


class PressureMap(_MeasuredMap):
    """The pressure in the muscle."""

    quantity: ClassVar[str] = "pressure_pa"
    unit: Literal[
        "Pa", "kPa", "MPa", "hPa", "bar", "mbar", "psi", "atm", "Torr", "mmHg", "inHg", "kgf/cm2"
    ]
    gauge: Annotated[bool, Field(description="relative to the atmosphere; else absolute")]
    noise: SensorNoise = None


class PositionMap(_MeasuredMap):
    """The displacement, positive in contraction."""

    quantity: ClassVar[str] = "position_m"
    unit: Literal["m", "mm", "cm", "um", "in"]
    noise: SensorNoise = None


class ForceMap(_MeasuredMap):
    """The pulling force at the muscle's end."""

    quantity: ClassVar[str] = "force_n"
    unit: Literal["N", "kN", "lbf", "kgf"] = "N"
    noise: SensorNoise = None


ColumnMap = TimeMap | ValveMap | PressureMap | PositionMap | ForceMap
MAPS: Mapping[str, type[ColumnMap]] = {
    "time": TimeMap,
    "valve": ValveMap,
    "pressure": PressureMap,
    "position": PositionMap,
    "force": ForceMap,
}
"""By the key of the map."""
KEYS = {part.quantity: key for key, part in MAPS.items()}
"""The key of the map by quantity."""


class LinesMap(Configured):
    """A part of a file, by its line numbers, or by rows from 1 in a file without lines."""

    first: Annotated[int, Field(ge=1)] = 1
    last: Annotated[int | None, Field(ge=1)] = None


class TextHints(Configured):
    """What the user says of a file of text; nothing said is found in the file."""

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


class ImportMap(TextHints):
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
    lines: Annotated[
        LinesMap | None, Field(description="the part of the file to import; else all of it")
    ] = None

    def parts(self) -> dict[str, ColumnMap]:
        """Return how each column is read, by quantity; time comes first if it has a column."""
        named = {quantity: getattr(self, key) for quantity, key in KEYS.items()}
        return {q: part for q, part in named.items() if part is not None and part.column}

    def to_si(self, quantity: str, raw: Floats) -> Floats:
        """Return a quantity in SI, pressure absolute, for its column of shape (n,)."""
        part = getattr(self, KEYS[quantity])
        scale = UNITS[quantity][part.unit]
        if quantity == TIME:
            return scale * raw
        value: Floats = scale * (part.gain * raw + part.offset)
        is_gauge = quantity == "pressure_pa" and part.gauge
        return value + self.atmospheric_pressure_pa if is_gauge else value

    def stated_noise(self) -> dict[str, float]:
        """Return the noise that is stated, as standard deviations in SI by quantity."""
        return {
            quantity: part.noise * UNITS[quantity][part.unit]
            for quantity, part in self.parts().items()
            if isinstance(part, (PressureMap, PositionMap, ForceMap)) and part.noise is not None
        }

    def as_keys(self) -> dict[str, Any]:
        """Return the keys of the map, without those that say nothing new."""
        said = self.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
        said |= {KEYS[quantity]: describe_part(part) for quantity, part in self.parts().items()}
        return {key: said[key] for key in (*MAPS, *said) if key in said}


def describe_part(part: ColumnMap) -> dict[str, Any]:
    """Return the keys of a column: its name and unit first, then what differs from the rule."""
    said = part.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    return {"column": part.column, "unit": part.unit, **said}


def describe_reading(part: ColumnMap) -> str:
    """Return a quantity, the unit of its column, and what is done to it."""
    keys = describe_part(part)
    scaled = f" x {keys['gain']:g}" if "gain" in keys else ""
    moved = f" {keys['offset']:+g}" if "offset" in keys else ""
    shift = f", shifted {keys['shift_s']:+g} s" if "shift_s" in keys else ""
    gauge = ""
    if isinstance(part, PressureMap):
        gauge = " gauge" if part.gauge else " absolute"
    return f"{part.quantity}{scaled}{moved}, {part.unit}{gauge}{shift}"


def write_map(keys: Mapping[str, Any], remarks: Mapping[str, str]) -> str:
    """Return keys as the text of a map, one a line, with remarks by key."""
    return "\n".join(write_key(key, value, remarks.get(key, "")) for key, value in keys.items())


def write_key(key: str, value: object, remark: str = "") -> str:
    """Return a line of a map."""
    return f"{key}: {_write_value(key, value)}" + (remark and f"  # {remark}")


def _write_value(key: str, value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {_write_value(k, v)}" for k, v in value.items()) + "}"
    if isinstance(value, str) and value.isprintable():
        return value if key in ("unit", "date_order") else quote(value)
    return to_json(value).decode()


def quote(text: str) -> str:
    """Return a text as YAML has it within quotes."""
    return "'" + text.replace("'", "''") + "'"
