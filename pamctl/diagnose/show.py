"""The proof: the coupled simulation on held-out records, before and after.

Blocks are fitted apart, each on the other's measured signal. Whether the model as a whole
got better shows only when the command alone drives it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, stack_residuals
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.measured.record import Array, Record
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters


@dataclass(frozen=True)
class HeldOutGap:
    """RMS of measurement minus simulation of one signal on the held-out records, in SI."""

    nominal: float
    recalibrated: float
    extended: float
    floor: float
    """What the sensor itself adds."""
    corrected: float | None = None
    """With an unnamed correction as well, where there is one."""

    @property
    def closed(self) -> float:
        """Share of the way from recalibrated to floor that the extended model goes."""
        way = self.recalibrated - self.floor
        return (self.recalibrated - self.extended) / way if way > 0.0 else 0.0

    def as_dict(self) -> dict[str, float]:
        """Return what the document holds."""
        found = {
            "nominal": self.nominal,
            "recalibrated": self.recalibrated,
            "extended": self.extended,
            "floor": self.floor,
        }
        return found if self.corrected is None else {**found, "corrected": self.corrected}


def simulate_coupled_run(record: Record, settings: PlantSettings) -> tuple[Array, Array]:
    """Simulate a record from its command alone; return position and absolute pressure."""
    driven = drive_coupled(plant_parameters(settings), record["valve_v"], record.step_s)
    return driven.position_m, driven.pressure_pa


def measure_gaps(
    evidence: Evidence, holdout: Sequence[Record], plants: Mapping[str, PlantSettings]
) -> dict[str, HeldOutGap]:
    """Compare the plants `nominal`, `recalibrated` and `extended` on the held-out records.

    Where only one block can be driven, that block's own output is compared.
    """
    found = {
        name: measure_rms_by_channel(evidence, holdout, plant) for name, plant in plants.items()
    }
    channels = next(iter(found.values()))
    return {
        channel: HeldOutGap(
            **{name: level[channel] for name, level in found.items()},
            floor=evidence.noises[channel].total,
        )
        for channel in channels
    }


def measure_rms_by_channel(
    evidence: Evidence, holdout: Sequence[Record], plant: PlantSettings
) -> dict[str, float]:
    """Return the RMS of measurement minus simulation by channel, in SI; see `measure_gaps`."""
    if len(evidence.blocks) == 2:
        return _measure_coupled_rms(evidence, holdout, plant)
    block = evidence.blocks[0]
    drives = evidence.holdout[block]
    left = rms(stack_residuals(drives, plant)) * drives[0].deviation
    return {"pressure_pa" if block == PRESSURE else "position_m": left}


def _measure_coupled_rms(
    evidence: Evidence, holdout: Sequence[Record], plant: PlantSettings
) -> dict[str, float]:
    errors: dict[str, list[Array]] = {"position_m": [], "pressure_pa": []}
    for record, drive in zip(holdout, evidence.holdout[MECHANICS], strict=True):
        counted = slice(None) if drive.rows is None else drive.rows
        position_m, pressure_pa = simulate_coupled_run(record, plant)
        for channel, simulated in (("position_m", position_m), ("pressure_pa", pressure_pa)):
            error = (record[channel] - simulated)[counted]
            if channel == "position_m":
                error = error - np.clip(np.mean(error), -drive.slack, drive.slack)
            errors[channel].append(error)
    return {channel: rms(np.concatenate(parts)) for channel, parts in errors.items()}
