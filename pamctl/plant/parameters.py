"""The plant's numbers as the kernels use them, its state, and its flat mapping.

A plant as a flat mapping {name: value}, which a fit varies.

Names are those of a plant file: `stiffness_n_per_m` for a parameter, `valve_spool.time_constant_s`
for an effect. A missing name has the paper's value, or the neutral value. Only names are validated:
a fit evaluates thousands of vectors, and keeps to the catalogue's ranges itself.
`pamctl.plant.model` converts to a plant file and back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from math import nan
from typing import Any, NamedTuple

from pamctl.base.texts import hint_at_nearest
from pamctl.plant.bristles import Bristles
from pamctl.plant.catalogue import (
    CATALOGUE,
    WITH_TERMS,
    Effects,
    MechanicsMemory,
    SensorMemory,
    ValveMemory,
    add_force,
    change_numbers,
    make_rest_memories,
)
from pamctl.plant.effects.description import ACTUATORS, Actuator
from pamctl.plant.paper import MuscleParameters, PaperParameters
from pamctl.plant.terms import (
    FORCE_AT,
    NO_MEMORY,
    TermDrivers,
    TermMemory,
    Terms,
    make_terms,
    push_of,
)


class PlantParameters(NamedTuple):
    """The paper's numbers and those of the effects.

    `pamctl.plant.parameters.parameters_of` makes it, with consistent products and flags. Kernels of
    the paper's equations take `paper` alone, and kernels of a part's effects take that part alone.
    """

    paper: PaperParameters
    effects: Effects
    valve_acts: bool
    """Whether any effect is active in this part; otherwise the paper's equations run alone."""
    air_acts: bool
    mechanics_act: bool
    sensors_act: bool
    direct: bool
    """A measured force, and a piston if there is one, drive the mechanics instead of the muscle."""
    stroke_m: float = 0.0
    """What moves is stopped at 0 and here; 0: nothing stops it."""
    drive_n_per_v: float = 0.0
    """Force of an axis's drive per volt of command; 0 where a log brings the force."""
    terms: Terms | None = None
    """None: a plant without terms does not compile them."""

    @property
    def atmospheric_pressure_pa(self) -> float:
        """Absolute pressure; for callers other than kernels."""
        return self.paper.atmospheric_pressure_pa

    @property
    def tank_pressure_pa(self) -> float:
        """Absolute pressure; for callers other than kernels."""
        return self.paper.tank_pressure_pa


class ValveState(NamedTuple):
    """State of the valve and memories of its effects."""

    spool_v: float = 0.0
    spool_rate_v_per_s: float = 0.0
    memory: Any = ValveMemory()
    term: TermMemory | None = None
    """Memory of the valve's term; None in a plant without terms."""


class AirState(NamedTuple):
    """State of the air upstream of the muscle."""

    supply_pa: float = nan
    """Pressure upstream of the valve; of a supply with two branches, of the slow one."""
    line_pa: float = nan
    """Pressure at the line's valve end, where the sensor is; without a line, in the muscle."""
    branch_pa: float = 0.0
    """By how much a supply's fast branch lowers the pressure."""
    warmth: float = 1.0
    """Temperature of the muscle's air over that of the walls, T / T_0."""


class MechanicsState(NamedTuple):
    """State of the bristles and memories of the effects on the mechanics."""

    bristles: Bristles = Bristles()
    memory: Any = MechanicsMemory()
    term: TermMemory | None = None
    """Memory of the mechanics' term; None in a plant without terms."""


class PlantState(NamedTuple):
    """State of Eq. 9 (x, v, absolute P), and the memories of each part's effects.

    With effects, start from `rest_state` or `vented_state`: the default memories are those of a
    plant at 0 m and an unknown pressure (NaN).
    """

    position_m: float
    velocity_m_per_s: float
    pressure_pa: float
    valve: ValveState = ValveState()
    air: AirState = AirState()
    sensors: Any = SensorMemory()
    mechanics: MechanicsState = MechanicsState()
    age_s: float = 0.0
    """Time since the plant's start, for drifts."""


def rest_state(p: PlantParameters, position_m: float, pressure_pa: float) -> PlantState:
    """Return a plant that has rested for long at a position and absolute pressure."""
    of_valve, of_mechanics, of_sensors = make_rest_memories(position_m, pressure_pa)
    of_term = None if p.terms is None else TermMemory()
    return PlantState(
        position_m,
        0.0,
        pressure_pa,
        ValveState(memory=of_valve, term=of_term),
        AirState(p.paper.tank_pressure_pa, pressure_pa),
        of_sensors,
        MechanicsState(memory=of_mechanics, term=of_term),
    )


def keep_in_stroke(p: PlantParameters, position_m: float) -> float:
    """Return the position between the stops, if there are any."""
    if p.stroke_m <= 0.0:
        return position_m
    return min(max(position_m, 0.0), p.stroke_m)


def vented_state(p: PlantParameters) -> PlantState:
    """Return the muscle at rest at atmospheric pressure: only an effect's force moves it."""
    rest_m = 0.0
    if p.mechanics_act and not p.direct:
        memory = MechanicsState().memory
        pull_n = add_force(p.effects.mechanics, memory, 0.0, 0.0, 0.0, 0.0, 0.0)
        if p.terms is not None:
            pull_n += push_of(p.terms.mechanics, FORCE_AT, NO_MEMORY, TermDrivers())
        stiffness = p.paper.stiffness_n_per_m
        rest_m += pull_n / stiffness if stiffness > 0.0 else 0.0
        rest_m = keep_in_stroke(p, rest_m)
    return rest_state(p, rest_m, p.paper.atmospheric_pressure_pa)


PAPER: dict[str, float] = MuscleParameters().model_dump()
"""Tables I and II in SI."""
ACTUATOR = "actuator"
"""Place of the actuator in `ACTUATORS`."""
GEOMETRY = ("chamber_volume_m3", "cylinder_area_m2", "cylinder_volume_m3", "stroke_m")
"""Numbers of what has no braid; 0 where they mean nothing."""
DRIVE = "drive_n_per_v"
"""Number of an axis that a run can drive; 0 elsewhere."""
_RIGID = {"damping_n_s_per_m": 1e12, "stiffness_n_per_m": 1e12}
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


_SIZES = {
    part: tuple(
        (f"{effect.name}.{p.name}", p.neutral)
        for effect in CATALOGUE.values()
        for p in effect.parameters
        if part in effect.parts and p.role == "size"
    )
    for part in ("valve", "air", "mechanics", "sensors")
}
_DEFAULTS = {ACTUATOR: 0.0, **dict.fromkeys((*GEOMETRY, DRIVE), 0.0), **PAPER, **NEUTRAL}


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
    has_braid = actuator == "muscle" or (actuator == "direct" and v[DRIVE] == 0.0)
    if not has_braid:
        v |= _leave_out_braid(v, actuator)
    paper = PaperParameters(
        mass_kg=v["mass_kg"],
        damping_n_s_per_m=v["damping_n_s_per_m"],
        stiffness_n_per_m=v["stiffness_n_per_m"],
        rest_length_m=v["rest_length_m"],
        braid_length_m=v["braid_length_m"],
        volume_scale=1.0 / (4.0 * math.pi * v["braid_turns"] ** 2) if has_braid else 0.0,
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
        cylinder_area_m2=v["cylinder_area_m2"],
        cylinder_volume_m3=v["cylinder_volume_m3"],
    )
    terms = make_terms(values)
    acting = {
        part: (terms is not None and getattr(terms, part).size != 0.0)
        or any(v[name] != neutral for name, neutral in sizes)
        for part, sizes in _SIZES.items()
    }
    return PlantParameters(
        paper=change_numbers(paper, v),
        effects=Effects(*groups),
        valve_acts=acting["valve"],
        air_acts=acting["air"],
        mechanics_act=actuator in ("direct", "cylinder")
        or v["stroke_m"] > 0.0
        or acting["mechanics"],
        sensors_act=acting["sensors"],
        direct=actuator == "direct",
        stroke_m=v["stroke_m"],
        drive_n_per_v=v[DRIVE],
        terms=terms,
    )


def _leave_out_braid(v: Mapping[str, float], actuator: Actuator) -> dict[str, float]:
    """Return the numbers of a plant without a braid; a chamber's walls do not move either.

    The braid's angle stays defined at any position: L_0 is longer than all strokes. Behind an
    axis's drive there is no valve: its pressure stays that of the atmosphere.
    """
    numbers = {
        "rest_length_m": _ENDLESS_M,
        "braid_length_m": 1.5 * _ENDLESS_M,
        "kinetic_friction_per_m": 0.0,
    }
    if actuator == "chamber":
        volume = {"cylinder_volume_m3": v["chamber_volume_m3"], "cylinder_area_m2": 0.0}
        return {**numbers, **volume, **_RIGID}
    if actuator == "direct":
        return {**numbers, "valve_gain_m2_per_v": 0.0, "cylinder_volume_m3": 1.0}
    return numbers


def _explain_unknown(name: str) -> str:
    return f"{name}: no such parameter of a plant{hint_at_nearest(name, _DEFAULTS)}"
