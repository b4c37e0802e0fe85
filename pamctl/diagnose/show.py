"""Step 5, show: the coupled simulation on held-out records, before and after.

Each block is fitted alone, driven by the other's measured signal. Whether the whole model
became better shows only when the command alone drives it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pamctl.diagnose.extend import assemble_plant
from pamctl.diagnose.fitting.evidence import SMALLEST_MISFIT
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.held_out_rms import measure_rms_by_channel
from pamctl.diagnose.measured.record import Record

EQUAL_SHARE = 1.05
"""Gaps within this ratio count as equal."""


@dataclass(frozen=True)
class HeldOutGap:
    """RMS of measurement minus simulation of one signal on the held-out records, in SI."""

    nominal: float
    recalibrated: float
    extended: float
    floor: float
    """RMS of the sensor's own noise."""
    corrected: float | None = None
    """With an unnamed correction added, where there is one."""

    @property
    def closed(self) -> float:
        """Share of the way from recalibrated to floor that the extended model goes."""
        way = self.recalibrated - self.floor
        return (self.recalibrated - self.extended) / way if way > 0.0 else 0.0

    def as_dict(self) -> dict[str, float]:
        """Return what the document holds."""
        levels = {
            "nominal": self.nominal,
            "recalibrated": self.recalibrated,
            "extended": self.extended,
            "floor": self.floor,
        }
        return levels if self.corrected is None else {**levels, "corrected": self.corrected}


def measure_gaps(base: Model, model: Model, holdout: Sequence[Record]) -> dict[str, HeldOutGap]:
    """Compare start model, recalibrated and extended model on the held-out records, by channel.

    Where the records drive only one block, that block's own output is compared.
    """
    evidence = base.evidence
    plants = {
        "nominal": evidence.nominal,
        "recalibrated": assemble_plant(base),
        "extended": assemble_plant(model),
    }
    levels = {
        name: measure_rms_by_channel(evidence, holdout, plant) for name, plant in plants.items()
    }
    return {
        channel: HeldOutGap(
            **{name: level[channel] for name, level in levels.items()},
            floor=evidence.noises[channel].total,
        )
        for channel in levels["nominal"]
    }


def is_no_worse(gaps: Mapping[str, HeldOutGap]) -> bool:
    """Tell whether the extended model makes no signal's gap larger than it was without it.

    A twentieth, and what is too small to matter, count as equal.
    """
    return all(
        gap.extended <= EQUAL_SHARE * min(gap.nominal, gap.recalibrated) + SMALLEST_MISFIT[channel]
        for channel, gap in gaps.items()
    )
