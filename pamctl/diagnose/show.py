"""Step 5, show: the coupled simulation on held-out records, before and after.

Each block is fitted alone, driven by the other's measured signal. Whether the whole model
became better shows only when the command alone drives it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.extend import assemble_plant
from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.evidence import SMALLEST_MISFIT, Evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import Floor
from pamctl.diagnose.fitting.held_out_rms import HeldOutErrors, simulate_held_out
from pamctl.diagnose.naming.stretches import average_squares, is_clearly_less

EQUAL_SHARE = 1.05
"""Gaps within this ratio count as equal."""


@dataclass(frozen=True)
class HeldOutGap:
    """RMS of measurement minus simulation of one signal on the held-out records, in SI."""

    nominal: float
    recalibrated: float
    extended: float
    floor: float
    """RMS of the sensor's own noise; where that is unknown, of the floor that was estimated."""

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


@dataclass(frozen=True)
class CoupledComparison:
    """The start model, the recalibrated and the extended model over the held-out records."""

    nominal: HeldOutErrors
    recalibrated: HeldOutErrors
    extended: HeldOutErrors

    def measure_gaps(self, part: Evidence, floors: Mapping[str, Floor]) -> dict[str, HeldOutGap]:
        """Return the gaps at the samples that `part` holds out, by channel.

        `floors` are those of the blocks.
        """
        levels = {
            name: errors.measure_rms(part)
            for name, errors in (
                ("nominal", self.nominal),
                ("recalibrated", self.recalibrated),
                ("extended", self.extended),
            )
        }
        return {
            channel: HeldOutGap(
                **{name: level[channel] for name, level in levels.items()},
                floor=_find_floor(part, floors[self.extended.blocks[channel]], channel),
            )
            for channel in levels["nominal"]
        }

    def list_worse_blocks(self, part: Evidence) -> frozenset[str]:
        """Return the blocks whose signals the extended model leaves really worse than before.

        A twentieth, what is too small to matter, and what a few stretches make, count as equal.
        """
        nominal, recalibrated, extended = (
            errors.select(part) for errors in (self.nominal, self.recalibrated, self.extended)
        )
        worse = set()
        for channel, block in self.extended.blocks.items():
            before = min(nominal[channel], recalibrated[channel], key=rms)
            after = extended[channel]
            period_s = float(np.median(part.holdout[block][0].step_s))
            if rms(after) > EQUAL_SHARE * rms(before) + SMALLEST_MISFIT[channel] and (
                is_clearly_less(average_squares(before, period_s), average_squares(after, period_s))
            ):
                worse.add(block)
        return frozenset(worse)


def _find_floor(part: Evidence, floor: Floor, channel: str) -> float:
    drives = next(d for d in part.holdout.values() if d[0].channel == channel)
    if floor.is_estimate:
        return floor.mean * drives[0].deviation
    return part.noises[channel].total


def compare_coupled(base: Model, model: Model) -> CoupledComparison:
    """Simulate start model, recalibrated and extended model over the held-out records.

    Where the records drive only one block, that block's own output is compared.
    """
    evidence = base.evidence
    plants = (evidence.nominal, assemble_plant(base), assemble_plant(model))
    return CoupledComparison(*(simulate_held_out(evidence, plant) for plant in plants))
