"""What the equations themselves make equal: no record can tell these apart.

A muscle's equations keep their form when all pressures are multiplied by one factor, when time of
the command is shifted, when a length is taken off at an end or was measured wrong. So an effect may
say the same as a number of the set-up, and then both are said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.setup.finding_words import advise_mending, describe
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.diagnose.setup.suspects import (
    ATMOSPHERE,
    HIGHEST_ATMOSPHERE_PA,
    LOWEST_ATMOSPHERE_PA,
    Kind,
    Suspect,
)
from pamctl.plant.model import PlantSettings, values_of

_EQUAL: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "muscle": (
        ("valve_gain_m2_per_v", "temperature_k", "gas_constant_j_per_kg_k", "braid_turns"),
        ("stiffness_n_per_m", "damping_n_s_per_m", "kinetic_friction_per_m", "braid_turns"),
        ("kinetic_friction_per_m", "braid_count", "braid_contact_area_m2"),
    ),
    "direct": (
        (
            "mass_kg",
            "damping_n_s_per_m",
            "stiffness_n_per_m",
            "scale of position_m",
            "scale of force_n",
        ),
    ),
    "chamber": (
        (
            "valve_gain_m2_per_v",
            "temperature_k",
            "gas_constant_j_per_kg_k",
            "chamber_volume_m3",
            "scale of valve_v",
        ),
    ),
}
"""Numbers of which no record shows more than a product, by actuator.

A muscle's air flows with K_Av n^2 sqrt(R T), its forces are 1 / n^2 against k and c, and mu_k, N
and A_b are one factor. Motion and force of a mechanism, in any units, fit the same equation with
another mass, damping and stiffness. A chamber fills with K_Av u sqrt(R T) / V.
"""


def list_equal_numbers(nominal: PlantSettings) -> tuple[tuple[str, ...], ...]:
    """Return the groups of numbers that no record of this actuator tells apart.

    A number that is 0 in the plant file, or known, is in none.
    """
    outside = {*nominal.known} if nominal.actuator != "muscle" else set()
    values = values_of(nominal)
    return tuple(
        tuple(n for n in names if n not in outside and values.get(n) != 0.0)
        for names in _EQUAL[nominal.actuator]
        if nominal.actuator != "direct" or "mass_kg" not in outside
    )


@dataclass(frozen=True)
class _Twin:
    """A number of the set-up that an effect's number is equal to."""

    effect_number: str
    kind: Kind
    number: str
    unit: str
    block: str
    value: Callable[[float, PlantSettings], float]
    is_the_same: bool
    """The effect and the set-up are two words for one thing; otherwise they are two causes."""


_TWINS = (
    _Twin("command_delay.delay_s", "skew", "valve_v", "s", "pressure", lambda v, _: -v, True),
    _Twin("null_offset.offset_v", "null_offset", "valve_v", "V", "pressure", lambda v, _: -v, True),
    _Twin(
        "end_cap.length_m",
        "plant_constant",
        "rest_length_m",
        "m",
        "mechanics",
        lambda v, plant: plant.parameters.rest_length_m - v,
        True,
    ),
    _Twin("encoder_scale.scale", "scale", "position_m", "1", "mechanics", lambda v, _: v, True),
    _Twin(
        "pressure_sensor_gain.gain",
        "plant_constant",
        ATMOSPHERE,
        "Pa",
        "pressure",
        lambda v, plant: v * plant.parameters.atmospheric_pressure_pa,
        False,
    ),
)


@dataclass(frozen=True)
class EqualFinding:
    """A finding that says the same of the data as an effect."""

    finding: SetupFinding
    effect: str
    is_the_same: bool


def find_equal_setups(
    numbers: Mapping[str, FittedNumber], nominal: PlantSettings, gain: float, left: float
) -> tuple[EqualFinding, ...]:
    """Return the set-up findings that are equal to named effects; `numbers` are the fitted ones."""
    found = []
    for twin in _TWINS:
        known = numbers.get(twin.effect_number)
        if known is None or nominal.actuator != "muscle":
            continue
        value = twin.value(known.value, nominal)
        ends = sorted((twin.value(known.low, nominal), twin.value(known.high, nominal)))
        if twin.number == ATMOSPHERE and not LOWEST_ATMOSPHERE_PA < value < HIGHEST_ATMOSPHERE_PA:
            continue
        effect = twin.effect_number.split(".")[0]
        said = _said(nominal, twin)
        suspect = Suspect(
            twin.kind, twin.number, twin.unit, 0.0, 0.0, (), 1.0, frozenset({twin.block})
        )
        finding = SetupFinding(
            twin.kind,
            twin.number,
            value,
            (ends[0], ends[1]),
            twin.unit,
            twin.block,
            gain,
            left,
            (effect,),
            advise_mending(suspect, value),
            describe(suspect, value, said),
            said,
            is_corrected=False,
        )
        found.append(EqualFinding(finding, effect, twin.is_the_same))
    return tuple(found)


def _said(nominal: PlantSettings, twin: _Twin) -> float | None:
    if twin.kind != "plant_constant":
        return None
    return float(getattr(nominal.parameters, twin.number))
