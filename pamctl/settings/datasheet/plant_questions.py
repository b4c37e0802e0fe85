"""The numbers of a new plant file, by actuator, each with its meaning and its default.

The list follows the settings. A number that is added there is in it, with its own description.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, get_args

from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings
from pamctl.plant.paper import ROOM_K, MuscleParameters
from pamctl.settings.datasheet.datasheet_units import DatasheetError, list_units

_OF_AIR = {
    "tank_pressure_pa", "gas_constant_j_per_kg_k", "temperature_k", "heat_capacity_ratio",
    "valve_gain_m2_per_v",
}  # fmt: skip
_OF_BRAID = {
    "rest_length_m", "braid_length_m", "braid_turns", "kinetic_friction_per_m", "braid_count",
    "braid_contact_area_m2",
}  # fmt: skip
_OF_MOTION = {"mass_kg", "damping_n_s_per_m", "stiffness_n_per_m"}
_NOT_OF = {
    "muscle": set(),
    "direct": _OF_AIR | _OF_BRAID,
    "chamber": _OF_BRAID | _OF_MOTION,
    "cylinder": _OF_BRAID,
}
"""Numbers that mean nothing to an actuator."""
_NO_DEFAULT = {
    "direct": _OF_MOTION,
    "chamber": {"chamber_volume_m3"},
    "cylinder": {"cylinder_area_m2", "cylinder_volume_m3", "stroke_m", *_OF_MOTION},
}
"""Numbers for which no other rig's value is a guess."""
_DEFAULTS = {"temperature_k": ROOM_K}
"""Where the paper's number is no guess for a rig of one's own."""
_EFFECTS = {"direct": ("piston",), "cylinder": ("external_load",)}
"""Effects that are part of an actuator, where the catalogue has them."""
_FIRST = ("atmospheric_pressure_pa",)
"""A gauge pressure needs it."""
_PLAIN_WORDS = {
    "atmospheric_pressure_pa": "pressure of the air in the laboratory",
    "mass_kg": "moving mass",
    "damping_n_s_per_m": "damping, force per speed; a guess will do",
    "stiffness_n_per_m": "stiffness of the spring, force per displacement; a guess will do",
    "rest_length_m": "length of the vented muscle between its ends, L_0",
    "braid_length_m": "length of one braid thread, b",
    "braid_turns": "turns of one braid thread around the muscle, n",
    "kinetic_friction_per_m": "friction of the braid, mu_k; a guess will do",
    "tank_pressure_pa": "pressure of the supply",
    "temperature_k": "temperature of the air",
    "gas_constant_j_per_kg_k": "gas constant of the air",
    "braid_count": "number of braid threads, N",
    "braid_contact_area_m2": "contact area of two braid threads, A_b",
    "valve_gain_m2_per_v": "opening of the valve per volt of command, K_Av",
    "chamber_volume_m3": "volume behind the valve, tubes included",
    "cylinder_area_m2": "area of the piston",
    "cylinder_volume_m3": "volume behind the piston at position 0, tubes included; half or twice "
    "will do, it is fitted",
    "stroke_m": "stroke: the piston moves from 0 to here",
}
"""What the settings describe by the paper's symbols."""


@dataclass(frozen=True)
class PlantQuestion:
    """One number of a plant file."""

    name: str
    """Dotted for a number of an effect."""
    meaning: str
    units: str
    default: float | None
    """None where it must be given."""
    is_optional: bool = False
    """An effect that may be absent."""
    field: FieldInfo | None = None

    def check(self, value: float) -> None:
        """Raise DatasheetError outside the limits of the settings."""
        limits = tuple(self.field.metadata) if self.field else ()
        kind: Any = Annotated[(float, *limits)] if limits else float
        try:
            TypeAdapter(kind).validate_python(value)
        except ValidationError as error:
            first = error.errors()[0]
            words = first["msg"].removeprefix("Input should be ")
            if "ge" in first.get("ctx", {}):
                words = f"at least {first['ctx']['ge']:g}"
            raise DatasheetError(f"{self.name}: must be {words} (got {value:g})") from None


def list_questions(actuator: str) -> tuple[PlantQuestion, ...]:
    """Return the questions of an actuator in their order."""
    fields = {
        name: field
        for name, field in PlantSettings.model_fields.items()
        if _is_number(field) and name in _NO_DEFAULT.get(actuator, set())
    }
    fields |= {
        name: field
        for name, field in MuscleParameters.model_fields.items()
        if name not in _NOT_OF[actuator]
    }
    ordered = sorted(fields, key=lambda name: name not in _FIRST)
    asked = [_make_question(actuator, name, fields[name]) for name in ordered]
    return (*asked, *_ask_effects(actuator))


def _is_number(field: FieldInfo) -> bool:
    return field.annotation is float or float in get_args(field.annotation)


def _make_question(actuator: str, name: str, field: FieldInfo) -> PlantQuestion:
    needed = name in _NO_DEFAULT.get(actuator, set())
    return PlantQuestion(
        name,
        _PLAIN_WORDS.get(name, field.description or name),
        list_units(name),
        None if needed else _DEFAULTS.get(name, field.default),
        field=field,
    )


def _ask_effects(actuator: str) -> list[PlantQuestion]:
    return [
        PlantQuestion(
            f"{effect}.{parameter.name}",
            f"{effect.replace('_', ' ')}: {parameter.meaning}",
            list_units(parameter.name),
            None,
            is_optional=True,
        )
        for effect in _EFFECTS.get(actuator, ())
        if effect in CATALOGUE
        for parameter in CATALOGUE[effect].parameters
        if not parameter.choices
    ]
