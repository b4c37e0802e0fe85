"""A plant file: which model, which parameters, which effects."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, pairwise
from typing import Annotated, Any, Literal

from pydantic import Field, create_model, model_validator

from hal.configured import Configured
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.correction_tables import Correction, CorrectionTable
from pamctl.plant.effects.description import EffectDescription, acts
from pamctl.plant.flat import ACTUATOR, parameters_of
from pamctl.plant.muscle_parameters import MuscleParameters
from pamctl.plant.parameters import PlantParameters


def _make_effect_settings(effect: EffectDescription) -> type[Configured]:
    fields: dict[str, Any] = {
        p.name: (
            Annotated[float, Field(ge=p.low, le=p.high, description=f"{p.meaning} ({p.unit})")],
            p.neutral,
        )
        if not p.choices
        else (Annotated[Literal[p.choices], Field(description=p.meaning)], p.choices[0])
        for p in effect.parameters
    }
    return create_model(effect.name, __base__=Configured, **fields)


_of_effects = {name: _make_effect_settings(effect) for name, effect in CATALOGUE.items()}
globals().update(_of_effects)  # pickle looks for them here when it sends them to a worker process
_effect_fields: dict[str, Any] = {
    name: (settings | None, None) for name, settings in _of_effects.items()
}
EffectSettings = create_model(
    "EffectSettings",
    __base__=Configured,
    __doc__="Active effects, by their names in the catalogue; all others do not act.",
    **_effect_fields,
)


Lines = Annotated[tuple[float, ...], Field(min_length=2, max_length=24)]


class TableSettings(Configured):
    """Values on a grid: linear between its lines, constant beyond them."""

    @model_validator(mode="after")
    def _check_table_shape(self) -> TableSettings:
        (first_name, first), (second_name, second), (name, rows) = self.__dict__.items()
        for axis, lines in ((first_name, first), (second_name, second)):
            if any(b <= a for a, b in pairwise(lines)):
                raise ValueError(f"{axis} must increase from each grid line to the next")
        if len(rows) != len(first) or any(len(row) != len(second) for row in rows):
            raise ValueError(
                f"{name} needs {len(first)} rows of {len(second)} values: a row for each line of "
                f"{first_name}, a value for each of {second_name}"
            )
        return self

    def table(self) -> CorrectionTable:
        """Return the table as the kernels read it."""
        first, second, rows = self.__dict__.values()
        return CorrectionTable(first, second, tuple(chain.from_iterable(rows)))


class PullSettings(TableSettings):
    """A force that the model lacks, over the muscle's displacement and its load."""

    displacement_m: Lines
    load: Annotated[Lines, Field(description="absolute pressure, Pa; a direct actuator's force, N")]
    pull_n: Annotated[tuple[tuple[float, ...], ...], Field(description="added to the pull")]


class FlowSettings(TableSettings):
    """A mass flow that the model lacks, over the valve's opening and the muscle's pressure."""

    opening_v: Lines
    pressure_pa: Annotated[Lines, Field(description="absolute")]
    flow_kg_per_s: Annotated[tuple[tuple[float, ...], ...], Field(description="into the muscle")]


class CorrectionSettings(Configured):
    """Tables for errors that no known effect explains; they are not a cause."""

    pull: PullSettings | None = None
    flow: FlowSettings | None = None


Deviation = Annotated[float, Field(ge=0)]


class NoiseSettings(Configured):
    """The sensors' noise, as standard deviations of one reading, where it is known."""

    pressure_pa: Annotated[Deviation | None, Field(description="Pa")] = None
    position_m: Annotated[Deviation | None, Field(description="m")] = None
    force_n: Annotated[Deviation | None, Field(description="N")] = None

    @property
    def stated(self) -> dict[str, float]:
        """The deviations that are stated, by channel."""
        return {name: value for name, value in self if value is not None}


class PlantSettings(Configured):
    """The model of a muscle and its valve."""

    base: Annotated[Literal["paper"], Field(description="Eq. 1 to 9")] = "paper"
    actuator: Annotated[
        Literal["muscle", "direct"],
        Field(description="direct: a measured force drives mass, spring and friction; no muscle"),
    ] = "muscle"
    parameters: MuscleParameters = MuscleParameters()
    effects: EffectSettings = EffectSettings()
    correction: Annotated[
        CorrectionSettings | None,
        Field(description="tables for what no effect explains; `pamctl diagnose --correction`"),
    ] = None
    noise: Annotated[
        NoiseSettings | None,
        Field(description="of the sensors, where it is known; else `diagnose` estimates it"),
    ] = None


def plant_parameters(settings: PlantSettings) -> PlantParameters:
    """Turn a plant file into the numbers that the kernels use."""
    p = parameters_of(values_of(settings))
    if settings.correction is None:
        return p
    pull, flow = settings.correction.pull, settings.correction.flow
    return p._replace(
        air_acts=p.air_acts or flow is not None,
        mechanics_act=p.mechanics_act or pull is not None,
        correction=Correction(
            None if pull is None else pull.table(), None if flow is None else flow.table()
        ),
    )


def values_of(settings: PlantSettings) -> dict[str, float]:
    """Return a plant file as a flat mapping, without the effects that it leaves out.

    The tables of a correction are not part of the mapping.
    """
    values: dict[str, float] = settings.parameters.model_dump()
    if settings.actuator == "direct":
        values[ACTUATOR] = 1.0
    for name, effect in settings.effects.model_dump(exclude_none=True).items():
        for parameter in CATALOGUE[name].parameters:
            value = effect[parameter.name]
            index = parameter.choices.index(value) if parameter.choices else value
            values[f"{name}.{parameter.name}"] = float(index)
    return values


def settings_of(values: Mapping[str, float]) -> PlantSettings:
    """Return the plant file of a flat mapping, validated; effects at neutral are left out."""
    parameters: dict[str, float] = {}
    effects: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        effect, dot, parameter = name.partition(".")
        if dot:
            effects.setdefault(effect, {})[parameter] = value
        elif name != ACTUATOR:
            parameters[name] = value
    acting = {
        name: _name_choices(name, numbers)
        for name, numbers in effects.items()
        if name not in CATALOGUE or acts(CATALOGUE[name], numbers)
    }
    actuator = "direct" if values.get(ACTUATOR) else "muscle"
    return PlantSettings.model_validate(
        {"actuator": actuator, "parameters": parameters, "effects": acting}
    )


def _name_choices(effect: str, numbers: Mapping[str, float]) -> dict[str, Any]:
    """Replace the numbers of choices by their names."""
    choices = (
        {p.name: p.choices for p in CATALOGUE[effect].parameters} if effect in CATALOGUE else {}
    )
    return {n: choices[n][round(v)] if choices.get(n) else v for n, v in numbers.items()}
