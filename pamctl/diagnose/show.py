"""The proof: the coupled simulation on held-out records, before and after.

Blocks are fitted apart, each on the other's measured signal. Whether the model as a whole
got better shows only when the command alone drives it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.blocks import PRESSURE
from pamctl.diagnose.evidence import Evidence
from pamctl.diagnose.records import Array, Record
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters


@dataclass(frozen=True)
class Gap:
    """RMS of measurement minus simulation of one signal on the held-out records, in SI."""

    nominal: float
    recalibrated: float
    extended: float
    floor: float
    """What the sensor itself adds."""

    @property
    def closed(self) -> float:
        """Share of the way from recalibrated to floor that the extended model goes."""
        way = self.recalibrated - self.floor
        return (self.recalibrated - self.extended) / way if way > 0.0 else 0.0

    def as_dict(self) -> dict[str, float]:
        """Return what the document holds."""
        return {
            "nominal": self.nominal,
            "recalibrated": self.recalibrated,
            "extended": self.extended,
            "floor": self.floor,
        }


def coupled(record: Record, settings: PlantSettings) -> tuple[Array, Array]:
    """Simulate a record from its command alone; return position and absolute pressure."""
    driven = drive_coupled(plant_parameters(settings), record["valve_v"], record.step_s)
    return driven.position_m, driven.pressure_pa


def gaps(
    evidence: Evidence, holdout: Sequence[Record], plants: Mapping[str, PlantSettings]
) -> dict[str, Gap]:
    """Compare the plants `nominal`, `recalibrated` and `extended` on the held-out records.

    Where only one block can be driven, that block's own output is compared.
    """
    if len(evidence.blocks) == 2:
        return _coupled_gaps(evidence, holdout, plants)
    block = evidence.blocks[0]
    channel = "pressure_pa" if block == PRESSURE else "position_m"
    drives = evidence.holdout[block]
    levels = {
        name: float(
            np.sqrt(np.mean(np.concatenate([d.residual(plant) for d in drives]) ** 2))
            * drives[0].deviation
        )
        for name, plant in plants.items()
    }
    return {channel: Gap(**levels, floor=evidence.noises[channel].total)}


def _coupled_gaps(
    evidence: Evidence, holdout: Sequence[Record], plants: Mapping[str, PlantSettings]
) -> dict[str, Gap]:
    squares: dict[str, dict[str, list[Array]]] = {"position_m": {}, "pressure_pa": {}}
    for name, plant in plants.items():
        for index, record in enumerate(holdout):
            rows = evidence.holdout[PRESSURE][index].rows
            counted = slice(None) if rows is None else rows
            position_m, pressure_pa = coupled(record, plant)
            for channel, simulated in (("position_m", position_m), ("pressure_pa", pressure_pa)):
                error = (record[channel] - simulated)[counted]
                if channel == "position_m":
                    slack = evidence.noises[channel].resolution
                    error = error - np.clip(np.mean(error), -slack, slack)
                squares[channel].setdefault(name, []).append(error**2)
    return {
        channel: Gap(
            **{n: float(np.sqrt(np.mean(np.concatenate(parts)))) for n, parts in by_name.items()},
            floor=evidence.noises[channel].total,
        )
        for channel, by_name in squares.items()
    }
