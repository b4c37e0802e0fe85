"""Measurement minus simulation on the held-out records, when the command alone drives the plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, Drive
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.measured.record import Array
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters


@dataclass(frozen=True)
class HeldOutErrors:
    """One plant's simulation of whole held-out records, and its errors, in SI.

    Both blocks are simulated coupled, from the command alone. Where the records drive only one
    block, that block's own output is compared.
    """

    simulated: Mapping[str, tuple[Array, ...]]
    """By channel, one array a record."""
    blocks: Mapping[str, str]
    """The block of each channel."""
    is_shown: bool = False
    """Simulated as the record's columns show it, not as it is: they may be scaled or late."""

    def select(self, part: Evidence) -> dict[str, Array]:
        """Return the errors at the samples that `part` holds out, by channel, in SI."""
        errors = {}
        for channel, runs in self.simulated.items():
            drives = part.holdout[self.blocks[channel]]
            shown = (
                run if self.is_shown else d.show_output(run)
                for d, run in zip(drives, runs, strict=True)
            )
            parts = [_error_of(d, run) for d, run in zip(drives, shown, strict=True)]
            errors[channel] = np.concatenate(parts)
        return errors

    def measure_rms(self, part: Evidence) -> dict[str, float]:
        """Return the RMS by channel at the samples that `part` holds out, in SI."""
        return {channel: rms(error) for channel, error in self.select(part).items()}


def _error_of(drive: Drive, simulated: Array) -> Array:
    return drive.residual_of(simulated) * drive.deviation


def simulate_held_out(evidence: Evidence, plant: PlantSettings) -> HeldOutErrors:
    """Simulate a plant over the held-out records."""
    if len(evidence.blocks) < 2:
        (block,) = evidence.blocks
        drives = evidence.holdout[block]
        channel = drives[0].channel
        simulated = {channel: tuple(d.simulate(plant) for d in drives)}
        return HeldOutErrors(simulated, {channel: block}, is_shown=True)
    p = plant_parameters(plant)
    pairs = zip(evidence.holdout[PRESSURE], evidence.holdout[MECHANICS], strict=True)
    finest = (replace(air, steps=max(air.steps, moving.steps)) for air, moving in pairs)
    driven = [drive_coupled(p, drive.valve_v, drive.grid) for drive in finest]
    return HeldOutErrors(
        {
            "position_m": tuple(run.position_m for run in driven),
            "pressure_pa": tuple(run.pressure_pa for run in driven),
        },
        {"position_m": MECHANICS, "pressure_pa": PRESSURE},
    )
