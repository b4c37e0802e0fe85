"""A plant as a flat mapping {name: value}, which a fit varies.

Names are those of a plant file: `stiffness_n_per_m` for a parameter, `valve_spool.time_constant_s`
for an effect. A missing name has the paper's value, or the neutral value. Only names are validated:
a fit evaluates thousands of vectors, and keeps to the catalogue's ranges itself.
`pamctl.plant.model` converts to a plant file and back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from pamctl.plant.catalogue import CATALOGUE, WITH_TERMS
from pamctl.plant.chains import Effects, change_numbers
from pamctl.plant.effects.description import ACTUATORS
from pamctl.plant.effects.places import Part
from pamctl.plant.muscle_parameters import MuscleParameters
from pamctl.plant.parameters import PaperParameters, PlantParameters
from pamctl.plant.terms.locations import make_terms
from pamctl.plant.terms.operators import Terms

PAPER: dict[str, float] = MuscleParameters().model_dump()
"""Tables I and II in SI."""
ACTUATOR = "actuator"
"""Place of the actuator in `ACTUATORS`."""
CHAMBER_VOLUME = "chamber_volume_m3"
_RIGID = {"damping_n_s_per_m": 1e12, "stiffness_n_per_m": 1e12, "kinetic_friction_per_m": 0.0}
"""The walls of a chamber: they move by less than a picometre per newton."""
_ENDLESS_M = 1e9


def _lay_out_group(group: Any) -> tuple[tuple[Any, tuple[str, ...]], ...]:
    """Return the class and the flat names of the fields of each effect of a group."""
    return tuple(
        (type(effect), tuple(f"{name}.{field}" for field in effect._fields))
        for name, effect in group._asdict().items()
    )


_LAYOUTS = tuple((type(group), _lay_out_group(group)) for group in Effects())
NEUTRAL: dict[str, float] = {
    f"{effect.name}.{p.name}": p.neutral
    for effect in WITH_TERMS.values()
    for p in effect.parameters
}
"""The neutral value of every parameter of every effect and term."""


def _sizes_of(part: Part) -> tuple[tuple[str, float], ...]:
    return tuple(
        (f"{effect.name}.{p.name}", p.neutral)
        for effect in CATALOGUE.values()
        for p in effect.parameters
        if part in effect.parts and p.role == "size"
    )


_VALVE, _AIR = _sizes_of("valve"), _sizes_of("air")
_MECHANICS, _SENSORS = _sizes_of("mechanics"), _sizes_of("sensors")
_DEFAULTS = {ACTUATOR: 0.0, CHAMBER_VOLUME: 0.0, **PAPER, **NEUTRAL}


def parameters_of(values: Mapping[str, float]) -> PlantParameters:
    """Return the numbers that the kernels use; raise KeyError for an unknown name."""
    if unknown := values.keys() - _DEFAULTS.keys():
        raise KeyError(_explain_unknown(min(unknown)))
    v = {**_DEFAULTS, **values}
    gamma = v["heat_capacity_ratio"]
    energy = v["gas_constant_j_per_kg_k"] * v["temperature_k"]
    critical = (2.0 / (gamma + 1.0)) ** (gamma / (gamma - 1.0))
    unchoked = math.sqrt(2.0 * gamma / ((gamma - 1.0) * energy))
    groups: Any = (
        group(*[kind(*[v[name] for name in names]) for kind, names in layout])
        for group, layout in _LAYOUTS
    )
    actuator = ACTUATORS[round(v[ACTUATOR])]
    direct = actuator == "direct"
    if actuator == "chamber":
        v |= _make_chamber_rigid(v)
    paper = PaperParameters(
        mass_kg=v["mass_kg"],
        damping_n_s_per_m=v["damping_n_s_per_m"],
        stiffness_n_per_m=v["stiffness_n_per_m"],
        rest_length_m=v["rest_length_m"],
        braid_length_m=v["braid_length_m"],
        volume_scale=1.0 / (4.0 * math.pi * v["braid_turns"] ** 2),
        friction_area_m=v["kinetic_friction_per_m"] * v["braid_count"] * v["braid_contact_area_m2"],
        tank_pressure_pa=v["tank_pressure_pa"],
        atmospheric_pressure_pa=v["atmospheric_pressure_pa"],
        specific_energy_j_per_kg=energy,
        valve_gain_m2_per_v=v["valve_gain_m2_per_v"],
        inverse_gamma=1.0 / gamma,
        critical_ratio=critical,
        choked_flow_s_per_m=unchoked
        * critical ** (1.0 / gamma)
        * math.sqrt(1.0 - critical ** ((gamma - 1.0) / gamma)),
        unchoked_flow_s_per_m=unchoked,
    )
    terms = make_terms(values)
    return PlantParameters(
        paper=change_numbers(paper, v),
        effects=Effects(*groups),
        valve_acts=_has_term(terms, "valve") or any(v[name] != neutral for name, neutral in _VALVE),
        air_acts=_has_term(terms, "air") or any(v[name] != neutral for name, neutral in _AIR),
        mechanics_act=direct
        or _has_term(terms, "mechanics")
        or any(v[name] != neutral for name, neutral in _MECHANICS),
        sensors_act=_has_term(terms, "sensors")
        or any(v[name] != neutral for name, neutral in _SENSORS),
        direct=direct,
        terms=terms,
    )


def _has_term(terms: Terms | None, part: str) -> bool:
    return terms is not None and getattr(terms, part).size != 0.0


def _make_chamber_rigid(v: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers of a muscle that has the chamber's volume (Eq. 2) and cannot move.

    Records may hold a position beside it. With b = sqrt(3) L_0 the volume is largest at 0, and
    L_0 is so long that a position of metres changes it by no bit.
    """
    length = _ENDLESS_M
    braid = math.sqrt(3.0) * length
    turns_squared = length * (braid * braid - length * length) / v[CHAMBER_VOLUME]
    numbers = {"rest_length_m": length, "braid_length_m": braid}
    return {**_RIGID, **numbers, "braid_turns": math.sqrt(turns_squared / (4.0 * math.pi))}


def _explain_unknown(name: str) -> str:
    near = get_close_matches(name, _DEFAULTS, n=1)
    return f"{name}: no such parameter of a plant" + (f"; did you mean {near[0]}?" if near else "")
