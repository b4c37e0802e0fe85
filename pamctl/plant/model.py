"""A plant file: which model, which parameters, which effects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    GetCoreSchemaHandler,
    SerializerFunctionWrapHandler,
    create_model,
    model_serializer,
    model_validator,
)
from pydantic_core import core_schema

from hal.calibration import Configured
from pamctl.base.texts import hint_at_nearest
from pamctl.plant.catalogue import CATALOGUE, WITH_TERMS
from pamctl.plant.effects.description import (
    ACTUATORS,
    Actuator,
    EffectParameter,
    acts,
)
from pamctl.plant.paper import ROOM_K, MuscleParameters
from pamctl.plant.parameters import (
    ACTUATOR,
    DRIVE,
    GEOMETRY,
    NEUTRAL,
    PAPER,
    PlantParameters,
    parameters_of,
)
from pamctl.plant.terms import LOCATIONS, NEEDS_INNER, SUFFIX, TERMS, numbers_of_operator

HUGE = 1e15
"""No machine has such a number in SI, nor its inverse; the kernels multiply several of them."""


class ActingNumbers:
    """Reads the numbers of one effect or term: a mapping, without a model of its own.

    There are some sixty, and every process that has a plant would build all their models. A term
    is size x operator(driver), added at its location or changing it by that share.
    """

    def __init__(self, name: str) -> None:
        """`name` is an effect's or a term's, as in the catalogue."""
        self._name = name

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        parameters = WITH_TERMS[self._name].parameters
        if self._name in TERMS:
            parameters = tuple(sorted(parameters, key=lambda p: not p.choices))
        schema: core_schema.CoreSchema = core_schema.typed_dict_schema(
            {p.name: _make_field(p, self._name in TERMS) for p in parameters},
            extra_behavior="forbid",
            ref=f"{self._name}:numbers",  # its name in the JSON schema
            metadata={"pydantic_js_updates": {"title": self._name}},
        )
        if self._name not in TERMS:
            return schema
        check = partial(_check_term, self._name)
        return core_schema.no_info_after_validator_function(check, schema)


_IN_EACH_TERM = ("size", "operator", "driver")
Numbers = dict[str, Any]


def _make_field(p: EffectParameter, is_term: bool) -> core_schema.TypedDictField:
    """Return a number with its limits; where the range follows the machine, they are wide."""
    low, high = p.low, p.high
    if p.is_scaled:
        low, high = (-HUGE if low < 0.0 else 0.0 if low == 0.0 else 1.0 / HUGE), HUGE
    one: core_schema.CoreSchema = core_schema.float_schema(ge=low, le=high, allow_inf_nan=False)
    meaning = f"{p.meaning} ({p.unit})"
    if p.choices:
        one, meaning = core_schema.literal_schema(list(p.choices)), p.meaning
    required = is_term and p.name in _IN_EACH_TERM
    if not required:
        default = p.choices[0] if p.choices else p.neutral
        one = core_schema.with_default_schema(one, default=default)
    return core_schema.typed_dict_field(
        one, required=required, metadata={"pydantic_js_updates": {"description": meaning}}
    )


def _check_term(name: str, term: Numbers) -> Numbers:
    """Refuse what this location does not have; leave out what the operator does not have."""
    location = LOCATIONS[name.removesuffix(SUFFIX)]
    operator, driver = term["operator"], term["driver"]
    if driver not in location.drivers:
        raise ValueError(f"driver {driver}: here it may be {', '.join(location.drivers)}")
    if not location.allows(operator, driver):
        of = " or ".join(location.memory_of) or "no driver"
        raise ValueError(f"operator {operator} has a memory, which here is one of {of}")
    if operator == "curve" and term["high"] <= term["low"]:
        raise ValueError("a curve's `high` must be greater than its `low`")
    if operator in NEEDS_INNER and term["inner"] <= 0.0:
        raise ValueError(f"inner of a {operator} must be greater than 0")
    used = {*_IN_EACH_TERM, *numbers_of_operator(operator)}
    return {number: value for number, value in term.items() if number in used}


def _acting_fields(names: Iterable[str]) -> dict[str, Any]:
    return {
        name.removesuffix(SUFFIX): (Annotated[Numbers, ActingNumbers(name)] | None, None)
        for name in names
    }


EffectSettings = create_model(
    "EffectSettings",
    __base__=Configured,
    __doc__="Active effects, by their names in the catalogue; all others do not act.",
    **_acting_fields(CATALOGUE),
)


class _OneTermAPart(Configured):
    @model_validator(mode="after")
    def _check_parts(self) -> _OneTermAPart:
        parts: dict[str, str] = {}
        for name, term in self.__dict__.items():
            part = LOCATIONS[name].part
            if term is not None and parts.setdefault(part, name) != name:
                raise ValueError(
                    f"{name} and {parts[part]} are both in the {part}, which holds one term; "
                    "leave one out"
                )
        return self


TermsSettings = create_model(
    "TermsSettings",
    __base__=_OneTermAPart,
    __doc__="What the catalogue has no name for, by location; one in each part of the plant.",
    **_acting_fields(TERMS),
)


Deviation = Annotated[float, Field(ge=0, le=HUGE)]


class NoiseSettings(Configured):
    """The sensors' noise, as standard deviations of one reading, where it is known."""

    pressure_pa: Deviation | None = None
    position_m: Deviation | None = None
    force_n: Deviation | None = None

    @property
    def stated(self) -> dict[str, float]:
        """The deviations that are stated, by channel."""
        return {name: value for name, value in self if value is not None}


class PlantSettings(Configured):
    """The model of a muscle and its valve, or of a mechanism of one axis."""

    base: Annotated[Literal["paper"], Field(description="Eq. 1 to 9")] = "paper"
    actuator: Annotated[
        Actuator,
        Field(
            description="direct: a measured force, and a piston if there is one, drive mass, "
            "spring and friction; no muscle. chamber: a volume that does not change, behind the "
            "valve. cylinder: a piston behind the valve, against mass, spring and friction"
        ),
    ] = "muscle"
    chamber_volume_m3: Annotated[
        float | None,
        Field(ge=1e-12, le=1e6, description="volume of a chamber, tubes included"),
    ] = None
    cylinder_area_m2: Annotated[
        float | None, Field(ge=1e-9, le=1e3, description="area of the piston of a cylinder")
    ] = None
    cylinder_volume_m3: Annotated[
        float | None,
        Field(
            ge=1e-12,
            le=1e6,
            description="volume behind the piston at position 0; a guess will do",
        ),
    ] = None
    stroke_m: Annotated[
        float | None,
        Field(
            ge=1e-6,
            le=1e3,
            description="stroke between two stops: a piston, or the load of a muscle that a floor "
            "carries, moves from 0 to here",
        ),
    ] = None
    drive_n_per_v: Annotated[
        float | None,
        Field(
            ge=1e-9,
            le=1e9,
            description="force of an axis's drive per volt of command, with `actuator: direct`; "
            "`run` and `tune` need it, `diagnose` does not fit it",
        ),
    ] = None
    parameters: MuscleParameters = MuscleParameters()
    effects: EffectSettings = EffectSettings()
    terms: Annotated[
        TermsSettings,
        Field(description="what no effect of the catalogue is; `pamctl diagnose` describes it"),
    ] = TermsSettings()
    known: Annotated[
        tuple[str, ...],
        Field(
            description="numbers that were measured well, by their dotted names (`mass_kg`, "
            "`piston.area_m2`): `pamctl diagnose` does not fit them"
        ),
    ] = ()
    guessed: Annotated[
        tuple[str, ...],
        Field(
            description="numbers that are guesses, by their dotted names: `pamctl diagnose` looks "
            "for them at least from half to twice their value"
        ),
    ] = ()
    noise: Annotated[
        NoiseSettings | None,
        Field(description="of the sensors, where it is known; else `diagnose` estimates it"),
    ] = None

    @model_validator(mode="after")
    def _check_actuator(self) -> PlantSettings:
        needed = ["damping_n_s_per_m"] if self.actuator in ("muscle", "cylinder") else []
        if self.actuator == "muscle" and self.stroke_m is None:
            needed.append("stiffness_n_per_m")
        for name in needed:
            if getattr(self.parameters, name) < 1.0 / HUGE:
                text = f"parameters.{name} of a {self.actuator} must be at least {1.0 / HUGE:g}"
                if name == "stiffness_n_per_m":
                    text += "; without a spring, stroke_m says what carries the load"
                raise ValueError(text)
        return self

    @model_validator(mode="after")
    def _check_geometry(self) -> PlantSettings:
        needed = GEOMETRY_OF.get(self.actuator, ())
        for name in GEOMETRY:
            may_be = (self.actuator, name) == ("muscle", "stroke_m")
            if not may_be and (name in needed) != (getattr(self, name) is not None):
                owner = next(kind for kind, names in GEOMETRY_OF.items() if name in names)
                raise ValueError(f"`actuator: {owner}` needs {name}, and no other does")
        if self.drive_n_per_v is not None and self.actuator != "direct":
            raise ValueError(f"{DRIVE} is a number of `actuator: direct` alone")
        if needed and "temperature_k" not in self.parameters.model_fields_set:
            at_room = self.parameters.model_copy(update={"temperature_k": ROOM_K})
            object.__setattr__(self, "parameters", at_room)  # the model is frozen
        return self

    @model_validator(mode="after")
    def _check_known(self) -> PlantSettings:
        names = {*MuscleParameters.model_fields, *NEUTRAL, *GEOMETRY_OF.get(self.actuator, ())}
        for key, listed in (("known", self.known), ("guessed", self.guessed)):
            for name in listed:
                if name not in names:
                    hint = hint_at_nearest(name, names)
                    raise ValueError(f"{key}: no number of a plant is called {name}{hint}")
        if both := {*self.known} & {*self.guessed}:
            raise ValueError(f"{min(both)} is either known or guessed: take it out of one list")
        return self

    @model_serializer(mode="wrap")
    def _leave_out_idle_numbers(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what says nothing: empty lists; the muscle's numbers, where there is none."""
        data: dict[str, Any] = write(self)
        for key in ("known", "guessed"):
            if not getattr(self, key):
                data.pop(key, None)
        for name in (*GEOMETRY_OF["cylinder"], DRIVE):
            if data.get(name) is None:
                data.pop(name, None)
        if not any(data.get("terms", {}).values()):
            data.pop("terms", None)
        means = MEANS.get(self.actuator)
        if means and "parameters" in data:
            data["parameters"] = {
                name: value
                for name, value in data["parameters"].items()
                if name in means or value != PAPER[name]
            }
        return data

    @property
    def acting(self) -> dict[str, dict[str, Any]]:
        """The settings of the effects and terms that the file states, by name before the dot."""
        stated: dict[str, dict[str, Any]] = self.effects.model_dump(exclude_none=True)
        # Most plants have none, and pydantic is slow to list what is missing.
        for name, term in self.terms if self.terms.model_fields_set else ():
            if term is not None:
                stated[f"{name}{SUFFIX}"] = term
        return stated


AXIS = ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m")
"""The parameters of a direct mechanism; all others are its effects, or the muscle's."""
AIR = ("tank_pressure_pa", "atmospheric_pressure_pa", "temperature_k", "valve_gain_m2_per_v")
"""What a cylinder has beside them, and a chamber alone."""
MEANS: Mapping[str, tuple[str, ...]] = {"direct": AXIS, "cylinder": AXIS + AIR, "chamber": AIR}
"""The parameters that an actuator without a braid has."""
GEOMETRY_OF: Mapping[str, tuple[str, ...]] = {"chamber": GEOMETRY[:1], "cylinder": GEOMETRY[1:]}
"""The numbers that an actuator without a braid must have."""


def plant_parameters(settings: PlantSettings) -> PlantParameters:
    """Turn a plant file into the numbers that the kernels use."""
    return parameters_of(values_of(settings))


def values_of(settings: PlantSettings) -> dict[str, float]:
    """Return a plant file as a flat mapping, without the effects that it leaves out.

    The names of known and guessed numbers are not part of the mapping.
    """
    values: dict[str, float] = settings.parameters.model_dump()
    if settings.actuator != "muscle":
        values[ACTUATOR] = float(ACTUATORS.index(settings.actuator))
    for name in GEOMETRY:
        if getattr(settings, name) is not None:
            values[name] = getattr(settings, name)
    if settings.drive_n_per_v is not None:
        values[DRIVE] = settings.drive_n_per_v
    for name, effect in settings.acting.items():
        for parameter in WITH_TERMS[name].parameters:
            value = effect.get(parameter.name, parameter.neutral)  # a term's idle number
            index = parameter.choices.index(value) if parameter.choices else value
            values[f"{name}.{parameter.name}"] = float(index)
    return values


def settings_of(values: Mapping[str, float]) -> PlantSettings:
    """Return the plant file of a flat mapping, validated; effects at neutral are left out."""
    parameters: dict[str, float] = {}
    effects: dict[str, dict[str, float]] = {}
    plain: dict[str, Any] = {name: values[name] for name in (*GEOMETRY, DRIVE) if values.get(name)}
    for name, value in values.items():
        effect, dot, parameter = name.partition(".")
        if dot:
            effects.setdefault(effect, {})[parameter] = value
        elif name not in (ACTUATOR, *GEOMETRY, DRIVE):
            parameters[name] = value
    acting = {
        name: _name_choices(name, numbers)
        for name, numbers in effects.items()
        if name not in WITH_TERMS or acts(WITH_TERMS[name], numbers)
    }
    terms = {n.removesuffix(SUFFIX): acting.pop(n) for n in [*acting] if n in TERMS}
    if terms:
        plain["terms"] = terms
    actuator = ACTUATORS[round(values.get(ACTUATOR, 0.0))]
    return PlantSettings.model_validate(
        {"actuator": actuator, **plain, "parameters": parameters, "effects": acting}
    )


def _name_choices(effect: str, numbers: Mapping[str, float]) -> dict[str, Any]:
    """Replace the numbers of choices by their names."""
    choices = (
        {p.name: p.choices for p in WITH_TERMS[effect].parameters} if effect in WITH_TERMS else {}
    )
    return {n: choices[n][round(v)] if choices.get(n) else v for n, v in numbers.items()}
