"""The residual of a plant on the held-out records, when the command alone drives it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.drives import MECHANICS, stack_residuals
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.measured.record import Array, Record
from pamctl.plant.drive import build_grid, drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters


def measure_rms_by_channel(
    evidence: Evidence, holdout: Sequence[Record], plant: PlantSettings
) -> dict[str, float]:
    """Return the RMS of measurement minus simulation by channel, in SI.

    Both blocks are simulated coupled, from the command alone. Where the records drive only one
    block, that block's own output is compared.
    """
    if len(evidence.blocks) == 2:
        return _measure_coupled_rms(evidence, holdout, plant)
    block = evidence.blocks[0]
    drives = evidence.holdout[block]
    left = rms(stack_residuals(drives, plant)) * drives[0].deviation
    return {drives[0].channel: left}


def _measure_coupled_rms(
    evidence: Evidence, holdout: Sequence[Record], plant: PlantSettings
) -> dict[str, float]:
    errors: dict[str, list[Array]] = {"position_m": [], "pressure_pa": []}
    for record, drive in zip(holdout, evidence.holdout[MECHANICS], strict=True):
        counted = slice(None) if drive.rows is None else drive.rows
        grid = build_grid(
            record.step_s,
            len(record),
            drive.steps,
            acts_after_s=record.acts_after_s,
            held_v=record.held_v,
        )
        driven = drive_coupled(plant_parameters(plant), record["valve_v"], grid)
        for channel in errors:
            error = (record[channel] - getattr(driven, channel))[counted]
            if channel == "position_m":
                error = error - np.clip(np.mean(error), -drive.slack, drive.slack)
            errors[channel].append(error)
    return {channel: rms(np.concatenate(parts)) for channel, parts in errors.items()}
