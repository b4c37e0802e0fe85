"""Rigs as a laboratory has them: small things that no catalogue has, beside what is hidden.

Each small thing ("dirt") is written as physics with units. Its size is chosen so that what it
leaves of the sensors' signals, after the best recalibration, is a drawn share of what the hidden
effect leaves: 5 to 30 %. All that is drawn comes from one seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hidden.effects import apply
from hidden.examination.cases import plant_on_paper
from hidden.excitations import PROGRAMS, Excitation
from hidden.rig import HiddenRig, Record, hidden_rig, in_floors
from hidden.rungs import Cause, Rung, Where, carried_rung, named_cause
from hidden.sensors import ADC_STEP_PA, ENCODER_STEP_M, Sensors, remember
from pamctl.plant.model import PlantSettings

Array = NDArray[np.float64]
Shape = Mapping[str, float]
"""What is drawn beside the size: a period, a place, a phase."""
Columns = dict[str, Array]

ATMOSPHERE_PA = 101.3e3
SPAN_PA = 340e3
SHARES = (0.05, 0.30)
ACCURACY = 0.03
"""Of a share, when the size is sought."""


@dataclass(frozen=True)
class Kind:
    """A kind of dirt. Its size is a number in `unit`, at most `largest` in a sound laboratory."""

    name: str
    unit: str
    largest: float
    where: tuple[Where, ...]
    draw: Callable[[np.random.Generator], dict[str, float]] = lambda rng: {}
    in_truth: Callable[[float, Shape], Mapping[str, float]] | None = None
    on_columns: Callable[[Columns, float, Shape], Columns] | None = None
    """What it does to the columns that the sensors show; they are in steps again afterwards."""
    names: tuple[str, ...] = ()
    """What the catalogue calls it, where it has the thing in a simpler form."""
    actuators: tuple[str, ...] = ("muscle",)


def _bow(c: Columns, size: float, shape: Shape) -> Columns:
    """Bend the pressure sensor's line between the atmosphere and the supply's pressure."""
    share = (c["pressure_pa"] - ATMOSPHERE_PA) / SPAN_PA
    return c | {"pressure_pa": c["pressure_pa"] + size * 4.0 * share * (1.0 - share)}


def _warm(c: Columns, size: float, shape: Shape) -> Columns:
    """Let the amplifier's zero follow its temperature, which rises after it is switched on."""
    rise = 1.0 - np.exp(-c["t_s"] / shape["time_s"])
    return c | {"pressure_pa": c["pressure_pa"] + size * rise}


def _hiss(c: Columns, size: float, shape: Shape) -> Columns:
    """Add noise that is correlated over `time_s`, as of a pipe with a turbulent flow."""
    rng = np.random.default_rng([59, int(shape["seed"]), len(c["t_s"])])
    keep = math.exp(-1e-3 / shape["time_s"])
    noise = remember(keep, 0.0, math.sqrt(1.0 - keep**2) * rng.normal(size=len(c["t_s"])))
    return c | {"pressure_pa": c["pressure_pa"] + size * noise}


def _late(column: str) -> Callable[[Columns, float, Shape], Columns]:
    """Show what was there some time ago: another task of the logger reads this column."""

    def make(c: Columns, size: float, shape: Shape) -> Columns:
        return c | {column: np.interp(c["t_s"] - size, c["t_s"], c[column])}

    return make


def _tip(c: Columns, size: float, shape: Shape) -> Columns:
    """Let the encoder's head tip over in its loose clamp, to and fro at two displacements."""
    tipped, over = np.zeros(len(c["t_s"])), 0.0
    for k, x in enumerate(c["position_m"]):
        over = 1.0 if x > shape["over_m"] else 0.0 if x < shape["back_m"] else over
        tipped[k] = over
    return c | {"position_m": c["position_m"] + size * tipped}


def _miss(c: Columns, size: float, shape: Shape) -> Columns:
    """Drop the converter's codes above each major carry: they show as the one below."""
    within = np.mod(c["pressure_pa"], shape["carry_pa"])
    return c | {"pressure_pa": c["pressure_pa"] - np.where(within < size, within, 0.0)}


def _cross(c: Columns, size: float, shape: Shape) -> Columns:
    """Couple the valve's line into the sensor's cable: so many pascals for each volt."""
    return c | {"pressure_pa": c["pressure_pa"] + size * c["valve_v"]}


def _cog(size: float, s: Shape) -> Mapping[str, float]:
    return {"cog_n": size, "cog_m": s["pitch_m"], "rail_m": s["rail_m"]}


BOTH = ("muscle", "direct")
STROKE = {"muscle": 20e-3, "direct": 9e-3}

DIRT = {kind.name: kind for kind in (
    Kind("cogging", "N", 8.0, (("force", "curve"),),
         lambda rng: {"pitch_m": rng.uniform(2.5e-3, 7e-3), "rail_m": rng.uniform(11e-3, 23e-3)},
         in_truth=_cog, actuators=BOTH),
    Kind("uneven_friction", "share", 0.6, (("friction", "curve"),),
         lambda rng: {"wave_m": rng.uniform(5e-3, 14e-3)},
         in_truth=lambda size, s: {"grip_wave": size, "grip_wave_m": s["wave_m"]},
         names=("position_friction",), actuators=BOTH),
    Kind("jerking_supply", "Pa", 30e3, (("supply", "time"),),
         lambda rng: {"period_s": rng.uniform(0.6, 2.5)},
         in_truth=lambda size, s: {"saw_pa": size, "saw_s": s["period_s"]},
         names=("supply_ripple",)),
    Kind("soft_stop", "N/m", 20e3, (("force", "curve"),),
         lambda rng: {"share": rng.uniform(0.72, 0.85)},
         in_truth=lambda size, s: {"stop_m": s["share"] * s["stroke_m"], "stop_n_per_m": size},
         actuators=BOTH),
    Kind("lopsided_spring", "N/m", 2e3, (("force", "curve"),),
         lambda rng: {"share": rng.uniform(0.4, 0.6)},
         in_truth=lambda size, s: {"kink_m": s["share"] * s["stroke_m"], "kink_n_per_m": size},
         actuators=BOTH),
    Kind("bowed_sensor", "Pa", 8e3, (("pressure_sensor", "curve"),), on_columns=_bow),
    Kind("warming_sensor", "Pa", 8e3, (("pressure_sensor", "time"),),
         lambda rng: {"time_s": rng.uniform(1.5, 6.0)}, on_columns=_warm),
    Kind("coloured_noise", "Pa", 3e3, (("pressure_sensor", ""),),
         lambda rng: {"time_s": rng.uniform(5e-3, 80e-3), "seed": rng.integers(1000)},
         on_columns=_hiss),
    Kind("late_pressure", "s", 4e-3, (("pressure_sensor", "lag"),),
         on_columns=_late("pressure_pa"), names=("pressure_sensor_lag", "skew.pressure_pa")),
    Kind("late_position", "s", 4e-3, (("encoder", "lag"),), on_columns=_late("position_m"),
         names=("skew.position_m",), actuators=BOTH),
    Kind("loose_clamp", "m", 0.3e-3, (("encoder", "memory"), ("encoder", "curve")),
         lambda rng: {"over": rng.uniform(0.5, 0.7), "back": rng.uniform(0.15, 0.35)},
         on_columns=_tip, actuators=BOTH),
    Kind("missing_codes", "Pa", 6e3, (("pressure_sensor", "curve"),),
         lambda rng: {"carry_pa": ADC_STEP_PA * float(rng.choice([128, 256, 512]))},
         on_columns=_miss),
    Kind("cross_talk", "Pa/V", 1500.0, (("pressure_sensor", "curve"),), on_columns=_cross,
         names=("crosstalk.pressure_pa",)),
)}  # fmt: skip

CLIMB_S = 3.0
RECALIBRATED = {
    "muscle": ("damping", "stiffness", "mu_k", "valve_m2_per_v", "supply_pa", "braid_m"),
    "direct": ("damping", "stiffness", "mass_kg"),
}
MAIN = {
    "muscle": ("valve_deadband", "valve_hysteresis", "valve_asymmetry", "valve_leak",
               "chamber_leak", "creep", "stribeck", "presliding", "coulomb_friction",
               "cubic_stiffness", "pressure_damping", "line_restriction", "braid_stretch",
               "valve_spool", "valve_saturation", "return_friction"),
    "direct": ("coulomb_friction", "cubic_stiffness", "creep"),
}  # fmt: skip
"""What is hidden, in turn: a recalibration leaves more than two floors of each at size 3."""


@dataclass(frozen=True)
class Dirt:
    """One small thing of one rig."""

    kind: Kind
    size: float
    share: float
    """RMS of what it leaves of the signals, in that of the hidden effect."""
    shape: Shape

    @property
    def cause(self) -> Cause:
        """What may be said of it; nobody must."""
        return Cause(self.kind.name, frozenset(self.kind.where), "none",
                     frozenset(self.kind.names))  # fmt: skip


@dataclass(frozen=True)
class DirtyRig:
    """One dirty rig. Without `is_hidden` its dirt is as large, but no effect is beside it."""

    seed: int
    actuator: str = "muscle"
    is_hidden: bool = True
    program: str = "short"

    @property
    def effect(self) -> str:
        """The name of what is hidden, by rotation over the seeds."""
        names = MAIN[self.actuator]
        return names[self.seed % len(names)]

    @property
    def multiple(self) -> float:
        """Its size, in the smallest that would matter."""
        return 30.0 if self.climbs else 3.0

    @property
    def climbs(self) -> bool:
        """Tell whether a force climbs in the first rest, in which dry friction holds."""
        return self.actuator == "direct" and self.effect == "coulomb_friction"

    @cached_property
    def clean(self) -> HiddenRig:
        """The rig without dirt and without the effect."""
        return hidden_rig({}, seed=self.seed, actuator=self.actuator)

    @cached_property
    def affected(self) -> HiddenRig:
        """The rig without dirt, with the effect."""
        rng = np.random.default_rng([61, self.seed])
        rig = self.clean
        truth, sensors = apply({self.effect: self.multiple}, rig.truth, rig.sensors, rng)
        return replace(rig, truth=truth, sensors=sensors)

    @cached_property
    def _probe(self) -> _Probe:
        return _Probe(self.affected, self.clean, self.actuator, self.programs[0])

    @property
    def programs(self) -> tuple[list[Excitation], list[Excitation]]:
        """The excitations to fit and to judge by."""
        train, held_out = PROGRAMS["direct" if self.actuator == "direct" else self.program](
            self.seed
        )
        if self.climbs:
            limit = 0.9 * self.affected.truth.coulomb_n
            train, held_out = ([_climb(run, limit) for run in runs] for runs in (train, held_out))
        return train, held_out

    @cached_property
    def dirts(self) -> tuple[Dirt, ...]:
        """Two to four, each sized to its share; kinds that cannot reach it are left out."""
        rng = np.random.default_rng([67, self.seed])
        wanted = int(rng.integers(2, 5))
        found: list[Dirt] = []
        for name in rng.permutation([*DIRT]):
            kind = DIRT[name]
            share = float(rng.uniform(SHARES[0] + 0.01, SHARES[1] - 0.01))
            shape = _in_stroke(kind.draw(rng), STROKE[self.actuator])
            if self.actuator not in kind.actuators or len(found) == wanted:
                continue
            dirt = self._probe.size_dirt(kind, shape, share)
            if dirt is not None:
                found.append(dirt)
        return tuple(found)

    def records(self) -> tuple[list[Record], list[Record]]:
        """Return the records for the fit, and those to judge by."""
        rig = self.affected if self.is_hidden else self.clean
        train, held_out = ([run_dirty(rig, r, self.dirts) for r in runs] for runs in self.programs)
        return train, held_out

    def start_plant(self) -> PlantSettings:
        """Return what the user knows of the rig."""
        return plant_on_paper(self.actuator)

    @property
    def causes(self) -> list[Cause]:
        """The hidden effect, at the rung that its data carry; and the dirt, which may be said."""
        dirt = [d.cause for d in self.dirts]
        if {d.kind.name for d in self.dirts} >= {"late_pressure", "late_position"}:
            # Two late columns are one that is early: that of the command.
            dirt.append(named_cause("command_delay", "none", "skew.valve_v"))
        return [named_cause(self.effect, self.rung), *dirt] if self.is_hidden else dirt

    @property
    def rung(self) -> Rung:
        """How far up the effect can be told from its rivals, by more than all dirt together."""
        if self.actuator == "direct":
            return "name"  # its three effects are unlike each other
        dirt = math.hypot(*(d.share for d in self.dirts))
        return carried_rung(self.effect, self.multiple, self.program, dirt)


class _Probe:
    """Measures what a change leaves of perfect sensors' signals after a recalibration."""

    def __init__(
        self, rig: HiddenRig, clean: HiddenRig, actuator: str, runs: Sequence[Excitation]
    ) -> None:
        self._rig, self._runs = _perfect(rig), runs[1:4]
        self._base = self._see(self._rig)
        moved = [self._moved(name) - self._base for name in RECALIBRATED[actuator]]
        self._tangents = np.stack([d.ravel() for d in moved], axis=1)
        self._tangents /= np.linalg.norm(self._tangents, axis=0)
        self.effect_left = self._left(self._see(_perfect(clean)))

    def size_dirt(self, kind: Kind, shape: Shape, share: float) -> Dirt | None:
        """Return the dirt that leaves this share; None where none of a sound size does."""
        size, found = 0.1 * kind.largest, 0.0
        for _ in range(6):
            found = self.measure_share(kind, shape, size)
            if abs(found - share) < ACCURACY * share:
                break
            size = min(size * min(max(share / max(found, 1e-9), 0.05), 20.0), kind.largest)
        is_sound = SHARES[0] <= found <= SHARES[1] and abs(found - share) < 0.3 * share
        return Dirt(kind, size, found, shape) if is_sound else None

    def measure_share(self, kind: Kind, shape: Shape, size: float) -> float:
        """Return what the dirt leaves of the signals, in what the effect leaves."""
        dirt = Dirt(kind, size, 0.0, shape)
        return self._left(self._see(self._rig, [dirt])) / self.effect_left

    def _moved(self, name: str) -> Array:
        truth = self._rig.truth
        moved = truth._replace(**{name: getattr(truth, name) * 1.001})
        return self._see(replace(self._rig, truth=moved))

    def _left(self, seen: Array) -> float:
        change = (seen - self._base).ravel()
        taken = self._tangents @ np.linalg.lstsq(self._tangents, change, rcond=None)[0]
        return float(np.sqrt(np.mean((change - taken) ** 2)))

    def _see(self, rig: HiddenRig, dirts: Sequence[Dirt] = ()) -> Array:
        """Return the signals in floors of their sensors, one row a channel."""
        return in_floors([run_dirty(rig, run, dirts) for run in self._runs])


def _perfect(rig: HiddenRig) -> HiddenRig:
    clear = Sensors(perfect=True, pressure_gain=rig.sensors.pressure_gain,
                    pressure_offset_pa=rig.sensors.pressure_offset_pa,
                    encoder_scale=rig.sensors.encoder_scale)  # fmt: skip
    return replace(rig, sensors=clear)


def run_dirty(rig: HiddenRig, run: Excitation, dirts: Sequence[Dirt]) -> Record:
    """Run the rig; let the measuring chain do to the columns what it does; convert them again."""
    truth = rig.truth
    for d in dirts:
        if d.kind.in_truth is not None:
            truth = truth._replace(**d.kind.in_truth(d.size, d.shape))
    record = replace(rig, truth=truth).run(run).record
    columns = record.columns()
    for d in dirts:
        if d.kind.on_columns is not None:
            columns = d.kind.on_columns(columns, d.size, d.shape)
    if dirts and not rig.sensors.perfect:
        for name, step in (("pressure_pa", ADC_STEP_PA), ("position_m", ENCODER_STEP_M)):
            if name in columns:
                columns[name] = np.round(columns[name] / step) * step
    return replace(record, **columns)


def _climb(run: Excitation, limit_n: float) -> Excitation:
    """Let somebody tighten the cable first: the force climbs, and friction holds the carriage."""
    assert run.force_n is not None
    n = round(CLIMB_S / 1e-3)
    slow = limit_n * np.concatenate([np.linspace(0.0, 1.0, n), np.linspace(1.0, 0.0, n // 10)])
    push = run.force_n * (limit_n / 0.9 / 20.0 + 1.0)
    return replace(run, force_n=np.concatenate([slow, push]))


def _in_stroke(shape: dict[str, float], stroke_m: float) -> dict[str, float]:
    shape = {name: float(value) for name, value in shape.items()}
    if "over" in shape:
        return {"over_m": shape["over"] * stroke_m, "back_m": shape["back"] * stroke_m}
    return shape | ({"stroke_m": stroke_m} if "share" in shape else {})
