"""From records and a plant file to what is missing: the door of the room."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.evidence.command_instants import CommandInstants, find_instants
from pamctl.diagnose.evidence.constants import FIT_STEPS, LEFT_TIMES, NAME_NATS
from pamctl.diagnose.evidence.fit import WeighedModel, Weigher, bound_gain
from pamctl.diagnose.evidence.forecast import foretell
from pamctl.diagnose.evidence.input_noise import count_input_noise, find_enough_noise
from pamctl.diagnose.evidence.intervals import Intervals
from pamctl.diagnose.evidence.ladder import Finding, climb_ladder, fit_number, judge_names
from pamctl.diagnose.evidence.likelihood import from_haar
from pamctl.diagnose.evidence.measuring_chain import (
    begin_at_soft_end,
    free_home,
    list_of_chain,
    share_scale,
)
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.pool import (
    CHAIN,
    PAPER_SCALES,
    WIDER,
    Hypothesis,
    Scales,
    Unknown,
    list_absent,
    list_effects,
    list_terms,
)
from pamctl.diagnose.evidence.run_pieces import (
    APART_M,
    CannotBeWeighed,
    Recording,
    Runs,
    hold_out,
)
from pamctl.diagnose.plant_numbers import FittedNumber, look_up_parameter
from pamctl.plant.catalogue import WITH_TERMS
from pamctl.plant.model import PlantSettings, values_of
from pamctl.plant.terms import CURVE, KNOTS, LOCATIONS, SUFFIX

Array = NDArray[np.float64]

CALIBRATED: Mapping[str, Mapping[str, float]] = {
    "muscle": {
        "valve_gain_m2_per_v": 0.1,
        "tank_pressure_pa": 0.02,
        "braid_length_m": 0.003,
        "damping_n_s_per_m": 0.1,
        "stiffness_n_per_m": 0.1,
        "kinetic_friction_per_m": 0.1,
        "mass_kg": 0.2,
        "braid_turns": 0.05,
    },
    "chamber": {"valve_gain_m2_per_v": 0.1, "tank_pressure_pa": 0.02},
    "direct": {"mass_kg": 0.2, "damping_n_s_per_m": 0.2, "stiffness_n_per_m": 0.2},
    "cylinder": {
        "valve_gain_m2_per_v": 0.1,
        "tank_pressure_pa": 0.02,
        "mass_kg": 0.2,
        "damping_n_s_per_m": 0.2,
        "stiffness_n_per_m": 0.1,
        "cylinder_volume_m3": 0.1,
    },
}
"""Numbers that every model recalibrates, and a visible share of each."""
OF_AIR = ("valve_gain_m2_per_v", "tank_pressure_pa", "cylinder_volume_m3")
"""The own numbers of the air and its valve."""
LOAD = "external_load.force_n"
"""The constant load of a direct mechanism; its force sensor's zero is the same to all data."""
GUESS = 2.0
"""A number that is usually known well, and here is a guess, is looked for so far up and down."""
KNOWN_WELL = 0.1
"""A number with a smaller visible share is measured with a tape or a gauge: 6 shares are its range;
all others are guesses, a factor of 12 (a direct mechanism: 50)."""
MAY_BE_ABSENT = ("kinetic_friction_per_m",)
"""Guesses that may be 0: not every braid rubs."""
RUN_AWAY = 1e3
"""Times the span of a channel: so far from it no model of the rig can be."""
ZERO_PA = 250.0
"""Homing leaves so much on a pressure sensor's zero; an encoder is homed within a count."""


@dataclass(frozen=True)
class EvidenceVerdict:
    """What the evidence says, and the models that it rests on."""

    findings: tuple[Finding, ...]
    intervals: Intervals
    """Of all numbers of the extended model, 90 % at least."""
    start: WeighedModel
    """The plant file's model, with nothing fitted."""
    base: WeighedModel
    """Recalibrated."""
    model: WeighedModel
    """Recalibrated with all findings in it."""
    weigher: Weigher
    pool: Mapping[str, Hypothesis]
    """What was asked, by name."""
    gap: Mapping[str, Mapping[str, float]]
    """RMS by stage (`nominal`, `recalibrated`, `extended`) and channel, SI; held out if any is."""
    noise_rms: Mapping[str, float]
    """Of each channel's sensor, and of what drives the model, passed through it, SI."""
    enough_noise: Mapping[str, float] = field(default_factory=dict)
    """By column that drives the model, the noise (a deviation) that would leave as much as is left,
    SI; empty where only noise is left, or where no noise would."""
    instants: Sequence[CommandInstants] = ()
    """When the commands acted, where the files do not have all of them."""
    stopped_by: KeyboardInterrupt | None = None
    """What interrupted the search; then no finding is judged, and more may be missing."""

    @property
    def held_s(self) -> float:
        """How long the files hold a command while the valve got others; 0 for one sample."""
        refresh = max((i.refresh for i in self.instants), default=1)
        return refresh * self.weigher.train.period_s if refresh > 1 else 0.0

    @property
    def sensor_rms(self) -> dict[str, float]:
        """The noise of each channel's sensor alone, SI."""
        more2 = dict(zip(self.noise_rms, self.weigher.further_noise2, strict=True))
        return {c: float(np.sqrt(max(rms**2 - more2[c], 0.0))) for c, rms in self.noise_rms.items()}

    @property
    def values(self) -> dict[str, float]:
        """The extended model's numbers by flat name, those of the measuring chain included."""
        return {**self.weigher.base, **self.model.values}

    @property
    def recalibrated(self) -> tuple[FittedNumber, ...]:
        """The start model's own numbers, as the extended model has them."""
        own = {n.name for n in self.base.numbers if not n.name.startswith(CHAIN)}
        return tuple(
            fit_number(n.name, float(v), self.intervals[n.name])
            for n, v in zip(self.model.numbers, self.model.x, strict=True)
            if n.name in own
        )

    @property
    def at_range(self) -> tuple[str, ...]:
        """Free numbers at an end of their range."""
        return tuple(
            n.name
            for n, v in zip(self.model.numbers, self.model.x, strict=True)
            if n.ends_at(float(v)) and not n.name.startswith(CHAIN)
        )

    @property
    def left_over_noise(self) -> Mapping[str, float]:
        """What the extended model leaves of each channel, over its sensor's noise (RMS)."""
        return {c: rms / self.noise_rms[c] for c, rms in self.gap["extended"].items()}


def weigh_evidence(
    records: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    plant: PlantSettings | None = None,
    *,
    without: Sequence[str] = (),
    noise: Mapping[str, float] | None = None,
    jobs: int = 1,
    tell: Callable[[str], None] = lambda _: None,
) -> EvidenceVerdict:
    """Find what is missing from a plant file. Raise ValueError where records lack an input.

    Names in `without` are left out of the pool. `noise` states standard deviations of sensors, SI,
    by channel. `jobs` records are simulated side by side; the result is the same for any number.
    A KeyboardInterrupt in the search ends it with what was found until then.
    """
    plant = plant or PlantSettings()
    weigher, start = prepare_weigher(records, held_out, plant, noise, jobs, holds_out=True)
    instants = find_instants(weigher)
    weigher.refine(start)  # also compiles what this rig needs
    weigher.simulations, weigher.begun_s = 0, time.process_time()
    base = _free_mistyped(weigher, start, weigher.settle(replace(start), FIT_STEPS))
    fit_s = (time.process_time() - weigher.begun_s) / max(weigher.simulations, 1)
    _check_it_stays(weigher, base)
    count_input_noise(weigher, base, noise)
    pool = {
        h.name: h
        for h in list_pool(weigher.train, weigher.base, plant)
        if not {h.name, h.family} & {*without}
    }
    search, stopped_by = NameSearch(weigher, pool, tell), None
    try:
        tell(foretell(weigher, base, len(pool), fit_s))
        m = base if _is_stated_noise(weigher, base, noise or {}) else search.improve(base)
        if instants:
            tell("fitting when the commands acted, beside what was found; then asking again")
            base = _refit_instants(weigher, instants, m, base)
            search = NameSearch(weigher, pool, tell)
            m = search.improve(base)
        count_input_noise(weigher, m, noise)
        m, findings, intervals = judge_names(search, base, m)
    except KeyboardInterrupt as interrupt:
        tell("interrupted: writing what was found so far; a second Ctrl-C leaves at once")
        m, stopped_by = search.found or base, interrupt
        findings, intervals = climb_ladder(search, base, m, judges=False)
    weigher.secants.clear()  # they are large, and a verdict keeps its weigher
    weigher.set_floor(m)
    weigher.leave_out(m)
    gap = {
        stage: _find_gap(weigher, each)
        for stage, each in (("nominal", start), ("recalibrated", base), ("extended", m))
    }
    noise2 = weigher.find_noise2(m)
    noise_rms = dict(zip(weigher.train.channels, map(float, np.sqrt(noise2)), strict=True))
    enough = _find_enough_noise(weigher, base, m, gap, findings, noise or {})
    return EvidenceVerdict(
        tuple(findings), intervals, start, base, m, weigher, pool, gap, noise_rms, enough,
        instants, stopped_by,
    )  # fmt: skip


def _is_stated_noise(weigher: Weigher, base: WeighedModel, noise: Mapping[str, float]) -> bool:
    """Tell whether noise that is stated of what drives the model leaves as much as the model."""
    is_stated = bool({*weigher.train.drivers} & {*noise})
    return is_stated and bool((weigher.find_robust2(base) <= weigher.find_noise2(base)).all())


def _find_enough_noise(
    weigher: Weigher, base: WeighedModel, m: WeighedModel, gap: Mapping[str, Mapping[str, float]],
    findings: Sequence[Finding], noise: Mapping[str, float],
) -> dict[str, float]:  # fmt: skip
    """Return the noise of a driver beside which the model leaves little, by column.

    Where something is found, and no name is sure: as much as the recalibrated model leaves.
    """
    noise2 = weigher.find_noise2(m)
    more2 = np.array([*gap["extended"].values()]) ** 2 / LEFT_TIMES**2 - noise2
    if any(f.level in ("set", "kind", "place") for f in findings):
        m, more2 = base, np.array([*gap["recalibrated"].values()]) ** 2 - noise2
    return find_enough_noise(weigher, m, more2, noise) if (more2 > 0.0).any() else {}


def _refit_instants(
    weigher: Weigher, instants: Sequence[CommandInstants], m: WeighedModel, base: WeighedModel
) -> WeighedModel:
    """Return the base model fitted to records whose commands act as a model says."""
    for each in instants:
        each.fit(m)
    weigher.forget_responses()
    return weigher.settle(WeighedModel((), base.numbers, {}, base.x.copy()), FIT_STEPS)


def _check_it_stays(weigher: Weigher, base: WeighedModel) -> None:
    """Raise CannotBeWeighed where even the recalibrated model leaves all that was measured."""
    runs = weigher.train
    for channel, off, shown in zip(runs.channels, from_haar(base.d), runs.shown, strict=True):
        if np.abs(off).max() > RUN_AWAY * np.ptp(shown):
            raise CannotBeWeighed(
                f"{channel}: the plant file's model runs away, whatever its free numbers are, and "
                "nothing can be compared with it: is a spring or a stop missing (stroke_m), or has "
                "a load the wrong size or sign?"
            )


def _free_mistyped(weigher: Weigher, start: WeighedModel, base: WeighedModel) -> WeighedModel:
    """Return the model in which numbers that end at their range go on, if that explains enough.

    A tank's pressure that was typed as the gauge shows it is no effect: with it, nothing is left.
    A number that an effect pulls to its range stays there, since the effect explains more.
    """
    held = {
        n.name
        for n, v in zip(base.numbers, base.x, strict=True)
        if n.ends_at(float(v)) and n.high < 2.0 * n.value
    }
    if not held:
        return base
    numbers = tuple(
        replace(n, low=max(n.value - WIDER * (n.value - n.low), n.value / WIDER),
                high=n.value + WIDER * (n.high - n.value)) if n.name in held else n
        for n in start.numbers
    )  # fmt: skip
    wide = weigher.settle(replace(base, numbers=numbers, x=base.x.copy()), FIT_STEPS)
    weigher.meet(base, wide)
    is_sure = bound_gain(base.left_out - wide.left_out)[0] > NAME_NATS
    return wide if is_sure and not weigher.is_much_left(wide) else base


def prepare_weigher(
    records: Sequence[Recording],
    held_out: Sequence[Recording],
    plant: PlantSettings,
    noise: Mapping[str, float] | None = None,
    jobs: int = 1,
    *,
    holds_out: bool = False,
) -> tuple[Weigher, WeighedModel]:
    """Return the likelihood of these records, and the plant file's model with nothing fitted.

    With `holds_out`, and without records in `held_out`, two stretches of each record are held out.
    """
    values = values_of(plant)
    train, away = Runs(records, values, jobs=jobs), None
    if held_out:
        away = Runs(held_out, values, train, jobs)
    elif holds_out:
        train, away = hold_out(train)
    numbers = list_calibrated(train, values, plant)
    start = WeighedModel((), numbers, {}, np.array([n.value for n in numbers]))
    return Weigher(train, away, values, noise), start


def _find_gap(weigher: Weigher, m: WeighedModel) -> dict[str, float]:
    runs = weigher.held_out or weigher.train
    off = runs.shown - runs.simulate({**weigher.base, **m.values}, min(runs.steps_s))
    rms = [np.sqrt(np.mean(o[~gone] ** 2)) for o, gone in zip(off, runs.hidden, strict=True)]
    return dict(zip(runs.channels, map(float, rms), strict=True))


def list_calibrated(
    runs: Runs, values: Mapping[str, float], plant: PlantSettings
) -> tuple[Unknown, ...]:
    """Return the numbers that every model frees.

    They are the plant's guesses, the sensors' zeros, and when in a sample a force acts.
    """
    found, tick = [], runs.period_s
    for name, share in list_guesses(values, plant, tick, is_imposed=runs.imposed).items():
        value = values[name]
        low, high = value * (1.0 - 6.0 * share), value * (1.0 + 6.0 * share)
        if share >= KNOWN_WELL:
            most = 50.0 if plant.actuator == "direct" else 12.0
            low, high = 0.0 if name in MAY_BE_ABSENT else value / most, value * most
        elif name in plant.guessed:
            low, high = value / GUESS, value * GUESS
        if name == "tank_pressure_pa":
            low = max(low, 1.01 * values["atmospheric_pressure_pa"])
        found.append(Unknown(name, value, low, high, share * value))
    found += list_stated(values, plant.known)
    if _lacks_command(runs, plant):
        found = [number for number in found if not is_of_air(number.name)]
    loaded = plant.actuator in ("direct", "cylinder") and not runs.imposed
    if loaded and LOAD not in values and LOAD not in plant.known:
        force = scales_of(runs, plant).force_n
        found.append(Unknown(LOAD, 0.0, -10.0 * force, 10.0 * force, 0.1 * force))
    if "force_n" in runs.stretches[0].inputs and not runs.imposed:
        found.append(Unknown(APART_M, 0.0, -tick, tick, 0.2 * tick))
    for channel, row, step in zip(runs.channels, runs.shown, runs.resolutions, strict=True):
        most = {"pressure_pa": ZERO_PA, "position_m": step}.get(channel, 1e3 * np.ptp(row))
        found.append(
            Unknown(f"{CHAIN}zero.{channel}", 0.0, -most, most, 0.2 * min(most, np.ptp(row)))
        )
    return tuple(found)


def _lacks_command(runs: Runs, plant: PlantSettings) -> bool:
    """Tell whether the measured pressure drives the model of a muscle or a cylinder."""
    return plant.actuator in ("muscle", "cylinder") and "valve_v" not in runs.stretches[0].inputs


def is_of_air(name: str) -> bool:
    """Tell whether a number is of the air and its valve: no record without a command shows it."""
    effect, dot, _ = name.partition(".")
    return name in OF_AIR or bool(dot and WITH_TERMS[effect].block == "pressure")


def list_guesses(
    values: Mapping[str, float], plant: PlantSettings, period_s: float, *, is_imposed: bool = False
) -> dict[str, float]:
    """Return the plant's own numbers that every model frees, with a visible share of each.

    The mass of a muscle without a load settles within a sample. By another width of the braid all
    forces and flows change by one factor: only a mass that shows, and is known, tells it.
    """
    left_out = {*plant.known}
    if plant.actuator == "muscle":
        hides = values["mass_kg"] < values["damping_n_s_per_m"] * 0.5 * period_s
        left_out |= {"mass_kg"} if hides else set()
        left_out |= {"braid_turns"} if hides or "mass_kg" not in plant.known else set()
    return {
        name: share
        for name, share in CALIBRATED[plant.actuator].items()
        if name not in left_out
        and values[name] != 0.0
        and (name == "damping_n_s_per_m" or not is_imposed)
    }


def list_stated(values: Mapping[str, float], known: Sequence[str] = ()) -> list[Unknown]:
    """Return the sizes of the effects and terms that a plant file states, to fit with its own.

    The sizes of a curve are its knots.
    """
    stated = []
    for name, number in values.items():
        effect, dot, _ = name.partition(".")
        if not dot or name in known:
            continue
        p, sizes = look_up_parameter(name), [name]
        if is_curve := values.get(f"{effect}.operator") == CURVE:
            sizes = [f"{effect}.knot_{k}" for k in range(1, KNOTS + 1)]
        is_size = p.role == "size" and number != p.neutral
        most = 50.0 * max(abs(values[size]) for size in sizes)
        if not most or not (name in sizes if is_curve else is_size):
            continue
        low, high = -most if p.low < 0.0 else 0.0, most
        if not p.is_scaled:  # the plant file has the same limits
            low, high = max(low, p.low), min(high, p.high)
        stated.append(Unknown(name, number, low, high, most / 500.0))
    return stated


def list_pool(runs: Runs, values: Mapping[str, float], plant: PlantSettings) -> list[Hypothesis]:
    """Return every hypothesis that these records may show."""
    machine = scales_of(runs, plant)
    reach = find_reach(runs)
    acting = {name.split(".")[0] for name in values if "." in name}
    taken = {LOCATIONS[t.removesuffix(SUFFIX)].part for t in acting if t.endswith(SUFFIX)}
    acting |= {*list_absent(plant.actuator, plant.parameters.stiffness_n_per_m)}
    pool = [
        *(free_home(h) for h in list_effects(plant.actuator, machine) if h.family not in acting),
        *list_of_chain(runs.channels, values, runs.period_s, plant.actuator, reach),
        *(h for h in list_terms(plant.actuator, reach, machine) if h.part not in taken),
    ]
    if plant.actuator in ("cylinder", "direct") and "position" in reach:
        pool = [begin_at_soft_end(h, reach, machine.force_n) for h in pool]
    if plant.actuator == "direct":
        seen = {"friction", "pull"} | ({"encoder"} if not runs.imposed else set())
        pool = [h for h in pool if h.place in seen and _is_driven(h, reach)]
    fitted = list_guesses(values, plant, runs.period_s, is_imposed=runs.imposed)
    stays = {("plant_constant", name) for name in (*plant.known, *fitted)}
    pool = [h for h in pool if h.setup not in stays]
    if runs.imposed:
        pool = [h for h in pool if not h.scan]
    if _lacks_command(runs, plant):
        pool = [h for h in pool if h.place in ("friction", "pull", "encoder")]
    if plant.actuator == "chamber":
        pool = [h for h in pool if h.place in ("valve", "supply", "air", "pressure_sensor")]
    if plant.actuator in ("direct", "cylinder"):  # a muscle's force is not in proportion to it
        pool = [share_scale(h, runs.drivers) for h in pool]
    return pool


def _is_driven(hypothesis: Hypothesis, reach: Mapping[str, tuple[float, float]]) -> bool:
    """Tell whether the records have what drives a law: no pressure, no law of the pressure."""
    needs_pressure = "pressure" in hypothesis.name or hypothesis.name == "piston"
    return "pressure" in reach or not needs_pressure


def find_reach(runs: Runs) -> dict[str, tuple[float, float]]:
    """Return the range of each driver in the records."""
    reach = {"time": (0.0, float(runs.when_s.max()))}
    columns: dict[str, list[Array]] = {}
    for stretch in runs.stretches:
        for name, column in stretch.inputs.items():
            columns.setdefault(name, []).append(column)
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    if "valve_v" in joined:
        reach["command"] = (float(joined["valve_v"].min()), float(joined["valve_v"].max()))
    if "pressure_pa" in joined:
        gauge = joined["pressure_pa"] - runs._atmosphere_pa
        reach["pressure"] = (0.0, float(np.quantile(gauge, 0.999)))
    if "position_m" in joined:
        x = joined["position_m"]
        reach["position"] = (float(np.quantile(x, 0.001)), float(np.quantile(x, 0.999)))
        many = max(1, round(0.01 / runs.period_s))
        rate = np.concatenate([(c[many:] - c[:-many]) for c in columns["position_m"]])
        speed = np.quantile(rate / (many * runs.period_s), (0.01, 0.99))
        reach["velocity"] = (float(speed[0]), float(speed[1]))
    return reach


def scales_of(runs: Runs, plant: PlantSettings) -> Scales:
    """Return what the machine reaches; for a muscle of the paper's size the catalogue's."""
    if plant.actuator in ("muscle", "chamber"):
        return PAPER_SCALES
    reach = find_reach(runs)
    forces = [s.inputs["force_n"] for s in runs.stretches if "force_n" in s.inputs]
    pressure = reach.get("pressure", (0.0, PAPER_SCALES.pressure_pa))[1]
    area_m2 = plant.cylinder_area_m2 or 1e-3
    force = 0.5 * float(np.ptp(np.concatenate(forces))) if forces else area_m2 * pressure
    low_m, high_m = reach.get("position", (0.0, plant.stroke_m or PAPER_SCALES.travel_m))
    speed = max(map(abs, reach.get("velocity", (high_m - low_m,))))
    return Scales(max(force, 1e-9), max(high_m - low_m, 1e-9), speed, max(pressure, 1.0))
