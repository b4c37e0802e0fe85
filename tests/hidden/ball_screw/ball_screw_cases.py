"""The ball screw as an examination: three guesses, with and without friction in the start model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from hidden.ball_screw.ball_screw_rig import ASYMMETRIC, SYMMETRIC, BallScrew, BallScrewRig
from hidden.rig import Record
from pamctl.plant.model import PlantSettings

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
