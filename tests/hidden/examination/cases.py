"""The examination: which rig, which excitation, which names were taken away; and its records."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hidden.effects import CALLED, OUT_OF_CATALOGUE, SINGLES, Size
from hidden.excitations import PROGRAMS
from hidden.rig import PULLED, HiddenRig, Record, hidden_rig
from pamctl.plant.model import MuscleParameters, PlantSettings

Damage = Literal["", "clipped", "millimetres", "gap", "shifted", "stuck", "missed_ticks"]


@dataclass(frozen=True)
class Case:
    """One examination. `effects` is what is hidden; the rest is what the examinee gets."""

    id: str
    group: str
    effects: dict[str, Size] = field(default_factory=dict)
    miscalibrated: bool = True
    program: str = "standard"
    actuator: str = "muscle"
    lacks: tuple[str, ...] = ()
    """Columns that this rig does not measure."""
    removed: tuple[str, ...] = ()
    """Names taken out of the catalogue."""
    encoder_homed: bool = True
    damage: Damage = ""
    repeat: int = 0

    @property
    def seed(self) -> int:
        """Fixed for a case and a repeat, different for each."""
        return zlib.crc32(f"{self.id}#{self.repeat}".encode()) % 1_000_000

    @property
    def rig(self) -> HiddenRig:
        """The rig that the case hides its effects in."""
        rig = hidden_rig(
            self.effects, seed=self.seed, miscalibrated=self.miscalibrated, actuator=self.actuator
        )
        missed = 3 if self.damage == "missed_ticks" else 0
        sensors = replace(rig.sensors, encoder_homed=self.encoder_homed, missed_ticks=missed)
        return replace(rig, sensors=sensors)

    def records(self) -> tuple[list[Record], list[Record]]:
        """Return the (training, held-out) records as the case's user has them."""
        rig = self.rig
        if self.program == "own":
            from hidden.own_run import own_run  # it needs the tests' own helpers

            return [own_run(rig, "diagnosis", seed=1)], [own_run(rig, "diagnosis", seed=2)]
        train, held_out = (
            [damage(rig.run(e).record.without(*self.lacks), self.damage) for e in runs]
            for runs in PROGRAMS[self.program](self.seed)
        )
        return train, held_out

    def start_plant(self) -> PlantSettings:
        """Return the model that the user starts from."""
        return plant_on_paper(self.actuator)


def plant_on_paper(actuator: str = "muscle") -> PlantSettings:
    """Return what a user knows of a rig: the paper's muscle, or the carriage's drawing."""
    if actuator == "muscle":
        return PlantSettings()
    drawing = MuscleParameters(
        mass_kg=PULLED.mass_kg, damping_n_s_per_m=PULLED.damping, stiffness_n_per_m=PULLED.stiffness
    )
    return PlantSettings(actuator="direct", parameters=drawing)


def damage(record: Record, how: Damage) -> Record:
    """Return the record with the faults of a careless user."""
    pressure, position = record.pressure_pa, record.position_m
    if how in ("", "missed_ticks"):
        return record
    if pressure is None or position is None:
        raise ValueError("only a whole record can be damaged")
    if how == "clipped":
        return replace(record, pressure_pa=np.minimum(pressure, 290e3))
    if how == "millimetres":
        return replace(record, position_m=position * 1e3)
    if how == "stuck":
        return replace(record, position_m=np.full_like(position, position[0]))
    if how == "shifted":
        return replace(record, pressure_pa=np.roll(pressure, 40))
    kept = np.ones(len(pressure), dtype=np.bool_)
    kept[len(kept) // 2 : len(kept) // 2 + 400] = False
    return replace(record, **{name: c[kept] for name, c in record.columns().items()})


def null_cases(each: int = 100, first: int = 0) -> Iterator[Case]:
    """Nothing is hidden and only parameters are wrong: no effect may be named."""
    for k in range(first, first + each):
        yield Case("null/nothing", "null", miscalibrated=False, repeat=k)
        yield Case("null/parameters", "null", repeat=k)


def single_cases() -> Iterator[Case]:
    """Every effect of the catalogue at three sizes."""
    for name in SINGLES:
        for size in (1, 3, 10):
            unhomed = name == "external_load"  # a homed encoder has forgotten it
            yield Case(
                f"single/{name}/{size}", "single", {name: size}, encoder_homed=not unhomed
            )  # fmt: skip


def form_cases() -> Iterator[Case]:
    """The same effects in other forms: the name is the same."""
    forms = {
        "valve_leak": "everywhere",
        "supply_droop": "static",
        "presliding": "maxwell_slip",
        "stribeck": "tustin",
        "creep": "two_branches",
        "valve_curve": "power",
        "polytropic": "wall_heat",
    }
    for name, form in forms.items():
        for size in (3, 10):
            long_holds = name == "creep" and size == 3
            yield Case(
                f"form/{name}-{form}/{size}",
                "form",
                {name: (size, form)},
                program="full" if long_holds else "standard",
            )


PAIRS: dict[str, dict[str, Size]] = {
    "deadband+spool": {"valve_deadband": 5, "valve_spool": 3},
    "leak+droop": {"chamber_leak": 5, "supply_droop": 5},
    "presliding+creep": {"presliding": 8, "creep": 8},
    "coulomb+cubic": {"coulomb_friction": 4, "cubic_stiffness": 6},
    "deadband+creep": {"valve_deadband": 5, "creep": 8},
    "delay+presliding": {"command_delay": 5, "presliding": 8},
    "polytropic+stribeck": {"polytropic": 5, "stribeck": 5},
    "valve_leak+backlash": {"valve_leak": 6, "encoder_backlash": 6},
}
"""Four within one block, four across both."""


def pair_cases() -> Iterator[Case]:
    """Two effects at once, and one rig with three."""
    for name, effects in PAIRS.items():
        yield Case(f"pair/{name}", "pair", effects)
    three: dict[str, Size] = {"valve_deadband": 5, "valve_spool": 3, "creep": 8}
    yield Case("triple/deadband+spool+creep", "triple", three)


def unknown_cases() -> Iterator[Case]:
    """Effects in no catalogue now or once, and each effect with its own name taken out."""
    for name in (*OUT_OF_CATALOGUE, *CALLED):
        yield Case(f"unknown/{name}", "unknown", {name: 3})
    yield Case("unknown/drift", "unknown", {"drift": 10})
    yield Case("unknown/moving_mass", "unknown", {"moving_mass": 10})
    for name in SINGLES:
        unhomed = name == "external_load"
        yield Case(
            f"left_out/{name}", "left_out", {name: 3}, removed=(name,), encoder_homed=not unhomed
        )


def blind_cases() -> Iterator[Case]:
    """The paper's squares cannot show these: no name, and the effect among the blind spots."""
    sizes = {"valve_deadband": 3, "valve_leak": 1, "chamber_leak": 1, "valve_hysteresis": 1}
    for name, size in sizes.items():
        yield Case(f"blind/{name}", "blind", {name: size}, program="squares")
    yield Case("blind/external_load", "blind", {"external_load": 1})


def closed_loop_cases() -> Iterator[Case]:
    """Records of a position controller, whose command carries the noise."""
    yield Case("closed_loop/parameters", "null", program="closed_loop")
    sizes = {"valve_deadband": 3, "valve_spool": 3, "command_delay": 5, "presliding": 8,
             "creep": 8, "coulomb_friction": 4, "chamber_leak": 8, "polytropic": 5}  # fmt: skip
    for name, size in sizes.items():
        yield Case(f"closed_loop/{name}", "closed_loop", {name: size}, program="closed_loop")


def partial_log_cases() -> Iterator[Case]:
    """Rigs that measure less: one block alone, or a mechanism without any air."""
    yield Case("no_command/parameters", "null", lacks=("valve_v",))
    for name, size in {"presliding": 8, "creep": 8, "return_friction": 8}.items():
        yield Case(f"no_command/{name}", "less", {name: size}, lacks=("valve_v",))
    yield Case("no_position/parameters", "null", lacks=("position_m",))
    for name, size in {"valve_deadband": 5, "valve_spool": 5}.items():
        yield Case(f"no_position/{name}", "less", {name: size}, lacks=("position_m",))
    pulled = Case("direct/parameters", "null", program="direct", actuator="direct")
    yield pulled
    several: tuple[dict[str, Size], ...] = (
        {"coulomb_friction": 5},
        {"cubic_stiffness": 8},
        {"creep": 8},
        {"encoder_backlash": 8},
        {"coulomb_friction": 5, "presliding": 8},
    )
    for effects in several:
        yield replace(pulled, id=f"direct/{'+'.join(effects)}", group="less", effects=effects)


def own_cases() -> Iterator[Case]:
    """The rigs under pamctl's own loop: `pamctl run --experiment diagnosis`, twice."""
    yield Case("own/parameters", "null", program="own")
    for name, size in {"valve_deadband": 5, "presliding": 8, "creep": 8}.items():
        yield Case(f"own/{name}", "own", {name: size}, program="own")


def damaged_cases() -> Iterator[Case]:
    """Records that must be refused, and two with holes that must be accepted."""
    for fault in ("clipped", "millimetres", "shifted", "stuck"):
        yield Case(f"bad/{fault}", "bad", {"valve_deadband": 5}, damage=fault)
    yield Case("odd/gap", "odd", {"valve_deadband": 5}, damage="gap")
    yield Case("odd/missed_ticks", "odd", {"valve_deadband": 5}, damage="missed_ticks")


QUICK = (
    "null/nothing",
    "null/parameters",
    "single/valve_deadband/3",
    "single/creep/10",
    "single/presliding/10",
    "single/chamber_leak/10",
    "pair/deadband+creep",
    "left_out/cubic_stiffness",
    "bad/clipped",
)
"""A few of everything, for minutes instead of hours: on the brief program."""


def quick_cases(repeat: int = 0) -> Iterator[Case]:
    """Return the quick ones, on the brief program."""
    every = {case.id: case for case in all_cases(1, repeat)}
    for name in QUICK:
        yield replace(every[name], program="brief")


def all_cases(null_each: int = 100, repeat: int = 0) -> Iterator[Case]:
    """Return the whole suite; each repeat has other seeds."""
    yield from null_cases(null_each, null_each * repeat)
    for made in (
        single_cases, form_cases, pair_cases, unknown_cases, blind_cases,
        closed_loop_cases, partial_log_cases, own_cases, damaged_cases,
    ):  # fmt: skip
        for case in made():
            yield replace(case, repeat=repeat)
