"""How well gains do on a plant: each error over its bound in Table IV, the worst counts.

The paper's two experiments in full would take a search too long. One cycle of experiment 1 has
all their parts: the transitions, and a steady state at each end. Its rests keep their length: the
steady error counts after 5 s of rest. With shorter rests the law would need so strong an integral
that it hunts.

The plants are what a rig built after the paper might turn out to be. Every number that the paper
gives is off by up to 20 %, and everything that it leaves out is there to some degree: the valve's
own dynamics, a dead band, delay, leaks, sensor noise and friction that creeps before it slides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.random import Generator, default_rng

from pamctl.control.experiment import TrackingSettings, plan_experiment
from pamctl.control.filters import HIGHEST_PER_RATE
from pamctl.offline.closed_loop import SimulatedRun, simulate_run
from pamctl.offline.merit import find_strictest
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.paper import braid_lever_m, force_area_m2
from pamctl.settings.resolve import RUN, RunSettings, resolve
from pamctl.signals import Phase

PARAMETER_TOLERANCE = 0.2
"""Share by which the paper's parameters may be off, either way."""
UNCERTAIN_PARAMETERS = (
    "damping_n_s_per_m",
    "stiffness_n_per_m",
    "kinetic_friction_per_m",
    "valve_gain_m2_per_v",
)

VALVE_HZ = (60.0, 150.0)
VALVE_DAMPING = (0.5, 1.0)
DEADBAND_V = (0.0, 0.3)
"""Overlap of one side, as in the catalogue of effects: the band is up to 0.6 V wide in all."""
DELAY_S = (0.0, 2e-3)
LEAK_M2 = (1e-11, 3e-9)
PRESLIDING_N_PER_M = (5e4, 2e6)
NOISE_V = (0.0005, 0.004)
"""Noise of the pressure sensor; 0.002 V is about 300 Pa."""

FARTHEST_M = 17.2e-3
"""The upper set point of the paper's experiments. A plant that cannot hold it is not drawn."""
_FORCE_TO_SPARE = 1.15
_NOISES = 4
"""Number of different noise sequences: drawing one takes longer than simulating a run."""


@dataclass(frozen=True)
class Member:
    """One plant of an ensemble, with its sensor."""

    name: str
    plant: PlantSettings
    noise_v: float = 0.002
    output_delay_ticks: int = 0
    seed: int = 0

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to another process as text: the models of effects are made at run time."""
        rest = (self.name, self.noise_v, self.output_delay_ticks, self.seed)
        return _rebuild_member, (self.plant.model_dump_json(), *rest)


@lru_cache(maxsize=1024)
def _rebuild_member(plant: str, name: str, *rest: Any) -> Member:
    return Member(name, PlantSettings.model_validate_json(plant), *rest)


def draw_ensemble(size: int, seed: int) -> list[Member]:
    """Draw plants; the same seed gives the same ones."""
    return [_draw_member(number, seed) for number in range(size)]


def _draw_member(number: int, seed: int) -> Member:
    """Draw one plant. Each has a generator of its own: a larger ensemble only adds plants."""
    draw = default_rng([seed, number])
    for parameters in _draw_parameters(draw):
        plant = PlantSettings.model_validate(
            {"parameters": parameters, "effects": _draw_effects(draw)}
        )
        if holds_the_farthest_point(plant):
            break
    noise_v = float(draw.uniform(*NOISE_V))
    return Member(f"{seed}-{number}", plant, noise_v, seed=int(draw.integers(_NOISES)))


def _draw_parameters(draw: Generator) -> Iterator[dict[str, float]]:
    nominal = PlantSettings().parameters
    gauge_pa = nominal.tank_pressure_pa - nominal.atmospheric_pressure_pa
    while True:
        *factors, tank = draw.uniform(
            1.0 - PARAMETER_TOLERANCE, 1.0 + PARAMETER_TOLERANCE, len(UNCERTAIN_PARAMETERS) + 1
        ).tolist()
        yield {
            **{
                n: f * getattr(nominal, n)
                for n, f in zip(UNCERTAIN_PARAMETERS, factors, strict=True)
            },
            "tank_pressure_pa": nominal.atmospheric_pressure_pa + tank * gauge_pa,
        }


def _draw_effects(draw: Generator) -> dict[str, dict[str, Any]]:
    width_v = float(draw.uniform(*DEADBAND_V))
    skew = float(draw.uniform(0.7, 1.0))
    return {
        "valve_spool": {
            "time_constant_s": 1.0 / (2.0 * math.pi * float(draw.uniform(*VALVE_HZ))),
            "damping_ratio": float(draw.uniform(*VALVE_DAMPING)),
        },
        "valve_deadband": {"fill_width_v": width_v, "exhaust_width_v": skew * width_v},
        "command_delay": {"delay_s": float(draw.uniform(*DELAY_S))},
        "valve_leak": {"area_m2": _draw_log_uniform(draw, LEAK_M2)},
        "chamber_leak": {"area_m2": _draw_log_uniform(draw, LEAK_M2)},
        "presliding": {"compliance_m_per_n": 1.0 / _draw_log_uniform(draw, PRESLIDING_N_PER_M)},
    }


def _draw_log_uniform(draw: Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(draw.uniform(*np.log(bounds))))


def holds_the_farthest_point(plant: PlantSettings) -> bool:
    """Tell whether the tank's pressure can push the muscle to the upper set point."""
    p = plant_parameters(plant).paper
    gauge_pa = p.tank_pressure_pa - p.atmospheric_pressure_pa
    push_n = gauge_pa * force_area_m2(p, FARTHEST_M)
    friction_n = p.friction_area_m * gauge_pa * braid_lever_m(p, FARTHEST_M)
    return push_n > _FORCE_TO_SPARE * (p.stiffness_n_per_m * FARTHEST_M + friction_n)


_MEAN_WEIGHT = 0.1
"""Weight of the mean error beside the worst one."""
TRIP_COST = 100.0
"""Cost of a run that safety ended at its beginning; less, the longer the run lasted."""

SHORT = TrackingSettings(kind="tracking", rest_s=10.0, cycles=1, approach_s=3.0, settle_s=0.5)
RESTING, MOVING = find_strictest("tracking-1"), find_strictest("tracking-2")
"""The strictest column of Table IV; in experiment 2 nothing rests."""
_BOUNDS = {"max": RESTING.max_m, "RMS": RESTING.rms_m, "steady": RESTING.steady_m}
_BOUNDS_MOVING = {"max": MOVING.max_m, "RMS": MOVING.rms_m}


class GainsVerdict(NamedTuple):
    """How gains did on one plant."""

    worst: float
    """The largest error over its bound; below 1 is inside Table IV."""
    why: str
    """Which error that is, or that safety ended the run."""
    figures_um: dict[str, float]
    mean: float
    """Mean of all errors over their bounds."""

    @property
    def cost(self) -> float:
        """The cost in a search: the worst error, and with a small weight the others.

        Many gains have the same worst error: the steady error is a whole number of counts.
        """
        return self.worst + _MEAN_WEIGHT * self.mean

    @property
    def is_inside(self) -> bool:
        """Every error is within its bound."""
        return self.worst <= 1.0


class _Case(NamedTuple):
    """A motion on which gains are judged, and the bounds of its errors, in m by name."""

    experiment: Any
    bounds: Mapping[str, float]
    number: str = ""
    """Behind the name of each error."""


@dataclass(frozen=True)
class GainsTrial:
    """A set-up in which gains are tried: `short` for a search, `whole` for what is reported."""

    length: Literal["short", "whole"] = "short"
    base: str = ""
    """Settings of a run, as JSON, whose rig is simulated; empty for the shipped one."""
    own_motion: bool = False
    """Whether the experiment of `base` is run, at any length, instead of the paper's two."""

    @property
    def duration_s(self) -> float:
        """How long the muscle moves for a verdict."""
        return sum(plan_experiment(case.experiment).duration_s for case in self._list_cases())

    @property
    def leaves_homing_out(self) -> bool:
        """Whether a run homes before its motion, which no trial does."""
        return bool(_read_base(self.base).rig.homing.enabled)

    @property
    def highest_hz(self) -> float:
        """The highest cut-off of a filter at the rig's rate."""
        return float(HIGHEST_PER_RATE * _read_base(self.base).rig.loop.rate_hz)

    def _list_cases(self) -> list[_Case]:
        if self.own_motion:
            return [_Case(_read_base(self.base).experiment, _BOUNDS)]
        if self.length == "short":
            return [_Case(SHORT, {**_BOUNDS, "moving RMS": MOVING.rms_m})]
        return [
            _Case(_resolve_base("tracking-1").experiment, _BOUNDS, " 1"),
            _Case(_resolve_base("tracking-2").experiment, _BOUNDS_MOVING, " 2"),
        ]

    def verdict(self, controller: Any, member: Member) -> GainsVerdict:
        """Run gains (a controller's settings) on one plant."""
        if max(controller.lpf1_hz, controller.lpf2_hz) > self.highest_hz:
            return GainsVerdict(TRIP_COST, "filter above the rate", {}, TRIP_COST)
        rig = _read_base(self.base).rig
        figures_um: dict[str, float] = {}
        ratios: dict[str, float] = {}
        for case in self._list_cases():
            run = simulate_run(_make_settings(controller, member, rig, case.experiment))
            if run.tripped_s is not None:
                share = len(run.t_s) / len(run.reference)
                lost = TRIP_COST * (1.0 - 0.9 * share)
                return GainsVerdict(lost, "safety trip", {}, lost)
            errors = _measure_errors(run)
            bounds = {**case.bounds}
            if math.isnan(errors["steady"]):  # it moves all the time, as experiment 2 does
                bounds["RMS"] = MOVING.rms_m
            for name, error_m in errors.items():
                if name in bounds and error_m == error_m:
                    figures_um[name + case.number] = error_m * 1e6
                    ratios[name + case.number] = error_m / bounds[name]
        why = max(ratios, key=lambda name: ratios[name])
        return GainsVerdict(ratios[why], why, figures_um, sum(ratios.values()) / len(ratios))


def _measure_errors(run: SimulatedRun) -> dict[str, float]:
    """Return the errors in m by name; `steady` is NaN where nothing rested for long."""
    found = run.merit()
    if found is None:
        raise ValueError("the experiment tracks nothing: it has no reference displacement")
    moving_m = run.error_m[run["phase"] == Phase.TRACK]
    return {
        "max": found.max_m,
        "RMS": found.rms_m,
        "moving RMS": float(np.sqrt(np.mean(moving_m**2))) if len(moving_m) else 0.0,
        "steady": found.steady_m,
    }


@lru_cache(maxsize=8)
def _read_base(text: str) -> RunSettings:
    return RUN.validate_json(text) if text else _resolve_base("tracking-1")


@cache
def _resolve_base(experiment: str) -> RunSettings:
    return resolve(experiment=experiment)


def _make_settings(controller: Any, member: Member, rig: Any, experiment: Any) -> RunSettings:
    sensor = {"sensor_noise_v": member.noise_v, "output_delay_ticks": member.output_delay_ticks}
    sim = rig.device_settings.model_copy(update=sensor)
    return _resolve_base("tracking-1").model_copy(
        update={
            "controller": controller,
            "plant": member.plant,
            "rig": rig.model_copy(update={"sim": sim}),
            "experiment": experiment,
            "seed": member.seed,
        }
    )
