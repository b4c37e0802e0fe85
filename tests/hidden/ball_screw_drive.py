"""A ball-screw drive under its own control, and the examination of it.

The numbers are those that Janot, Gautier and Brunot identified on their drive (EMPS, "Data set and
reference models of EMPS", Nonlinear System Identification Benchmarks, 2019). Nothing of it is
pamctl's: the motion is a time-stepping scheme with set-valued friction, in steps of 50 us.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hidden.rig import Record
from pamctl.kernel.calls import machine
from pamctl.plant.model import PlantSettings

Array = NDArray[np.float64]

TICK_S = 1e-3
ENCODER_STEP_M = 1e-6
STROKE_M = 0.24


class BallScrew(NamedTuple):
    """The truth: force F = M a + viscous v + dry + load, each friction by direction."""

    mass_kg: float = 95.11
    viscous_up: float = 203.5
    viscous_down: float = 203.5
    dry_up_n: float = 20.39
    dry_down_n: float = 20.39
    load_n: float = -3.16


SYMMETRIC = BallScrew()
ASYMMETRIC = BallScrew(
    viscous_up=166.7, viscous_down=240.4, dry_up_n=20.14, dry_down_n=20.63, load_n=0.0
)
"""The published numbers of the model with a friction for either direction, and no load."""


@dataclass(frozen=True)
class BallScrewRig:
    """The drive with its encoder, its motor and its controller."""

    truth: BallScrew = SYMMETRIC
    motor_noise_n: float = 0.6
    """Force that the motor adds by itself, drawn anew each tick; nobody measures it."""
    sensor_noise_n: float = 0.3
    encoder_step_m: float = ENCODER_STEP_M

    def run(self, name: str, seed: int, seconds: float = 25.0) -> Record:
        """Follow trapezoidal profiles to and fro; return what force sensor and encoder showed."""
        rng = np.random.default_rng([9511, seed])
        wanted_m, wanted_v = trapezoids(seconds, rng)
        ripple_n = rng.normal(0.0, self.motor_noise_n, len(wanted_m))
        shown_m, applied_n = np.empty(len(wanted_m)), np.empty(len(wanted_m))
        phase = float(rng.uniform(0.0, 1.0))
        machine(_follow)(
            self.truth, wanted_m, wanted_v, ripple_n, self.encoder_step_m, phase, shown_m, applied_n
        )
        # The sensor averages over a tick around its instant.
        felt_n = 0.5 * (applied_n + np.concatenate([applied_n[:1], applied_n[:-1]]))
        felt_n += rng.normal(0.0, self.sensor_noise_n, len(felt_n))
        return Record(name, np.arange(len(wanted_m)) * TICK_S, position_m=shown_m, force_n=felt_n)


def trapezoids(seconds: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return wanted positions and speeds: strokes of 0.24 m at up to 0.4 m/s, with rests."""
    speeds: list[Array] = [np.zeros(300)]
    direction = 1.0
    while sum(map(len, speeds)) < seconds / TICK_S:
        top, ramp_s = rng.choice([0.4, 0.3, 0.2, 0.12]), rng.uniform(0.25, 0.5)
        flat_s = STROKE_M / top - ramp_s
        ramp = np.linspace(0.0, 1.0, round(ramp_s / TICK_S), endpoint=False)
        stroke = np.concatenate([ramp, np.ones(round(flat_s / TICK_S)), 1.0 - ramp]) * top
        stroke *= STROKE_M / (np.sum(stroke) * TICK_S)
        speeds += [direction * stroke, np.zeros(round(rng.uniform(0.2, 0.5) / TICK_S))]
        direction = -direction
    wanted_v = np.concatenate(speeds)[: round(seconds / TICK_S)]
    return np.cumsum(wanted_v) * TICK_S, wanted_v


def _follow(p, wanted_m, wanted_v, ripple_n, encoder_step_m, phase, shown_m, applied_n):
    """Close the loop: position P with speed feed-forward, speed P; 350 N at the most."""
    x, v, seen_v = 0.0, 0.0, 0.0
    h = 1e-3 / 20
    for k in range(len(wanted_m)):
        shown_m[k] = math.floor(x / encoder_step_m + phase) * encoder_step_m
        if k:
            seen_v += 0.3 * ((shown_m[k] - shown_m[k - 1]) / 1e-3 - seen_v)
        asked_v = wanted_v[k] + 25.0 * (wanted_m[k] - shown_m[k])
        force = min(max(6000.0 * (asked_v - seen_v), -350.0), 350.0)
        applied_n[k] = force
        for _ in range(20):
            push = p.mass_kg * v + h * (force + ripple_n[k] - p.load_n)
            forward = (push - h * p.dry_up_n) / (p.mass_kg + h * p.viscous_up)
            backward = (push + h * p.dry_down_n) / (p.mass_kg + h * p.viscous_down)
            after = forward if forward > 0.0 else min(backward, 0.0)
            x += 0.5 * h * (v + after)
            v = after


GUESSES = (0.5, 1.0, 2.0)


@dataclass(frozen=True)
class BallScrewCase:
    """One examination: the truth, and what its user guesses."""

    truth: BallScrew
    guess: float
    """Mass and damping of the start model over the published ones."""
    knows_friction: bool
    """The start model has dry friction already; then only asymmetry can be missing."""

    @property
    def id(self) -> str:
        """Name the case."""
        form = "symmetric" if self.truth == SYMMETRIC else "asymmetric"
        known = "-friction_known" if self.knows_friction else ""
        return f"ball_screw/{form}{known}/{self.guess:g}"

    @property
    def names(self) -> frozenset[str]:
        """The effects that a right diagnosis names."""
        missing = set() if self.knows_friction else {"coulomb_friction"}
        if self.truth.viscous_up != self.truth.viscous_down:
            missing.add("viscous_asymmetry")
        return frozenset(missing)

    @property
    def numbers(self) -> dict[str, float]:
        """The plant's numbers in the terms of a plant file.

        A dry friction that differs between the directions is a constant load beside its mean: no
        data tell the two apart.
        """
        p = self.truth
        mean_viscous = 0.5 * (p.viscous_up + p.viscous_down)
        found = {
            "mass_kg": p.mass_kg,
            "damping_n_s_per_m": mean_viscous,
            "coulomb_friction.force_n": 0.5 * (p.dry_up_n + p.dry_down_n),
            "external_load.force_n": p.load_n + 0.5 * (p.dry_up_n - p.dry_down_n),
        }
        if p.viscous_up != p.viscous_down:
            found["viscous_asymmetry.share"] = p.viscous_up / mean_viscous - 1.0
        return found

    def start_plant(self) -> PlantSettings:
        """Return the start model: no spring, guessed mass and damping."""
        dry = {"coulomb_friction": {"force_n": self.guess * SYMMETRIC.dry_up_n}}
        return PlantSettings.model_validate(
            {
                "actuator": "direct",
                "parameters": {
                    "mass_kg": self.guess * SYMMETRIC.mass_kg,
                    "damping_n_s_per_m": self.guess * SYMMETRIC.viscous_up,
                    "stiffness_n_per_m": 0.0,
                },
                "effects": dry if self.knows_friction else {},
            }
        )

    def records(self) -> tuple[list[Record], list[Record]]:
        """Return the (training, held-out) records."""
        rig = BallScrewRig(self.truth)
        return [rig.run("fit", seed=1)], [rig.run("judge", seed=2), rig.run("confirm", seed=3)]


def ball_screw_cases() -> Iterator[BallScrewCase]:
    """Every truth from every guess; asymmetry also where friction is known."""
    for guess in GUESSES:
        yield BallScrewCase(SYMMETRIC, guess, knows_friction=False)
        yield BallScrewCase(ASYMMETRIC, guess, knows_friction=False)
        yield BallScrewCase(ASYMMETRIC, guess, knows_friction=True)
