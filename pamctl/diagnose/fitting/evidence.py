"""What a diagnosis goes by: the drives of both blocks, and how well the sensors see."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pamctl.diagnose.fitting.drives import (
    MECHANICS,
    MODELLED_HZ,
    PRESSURE,
    SMOOTH_HZ,
    Drive,
    contraction_m,
    prepare_force_drive,
    prepare_mechanics_drive,
    prepare_pressure_drive,
)
from pamctl.diagnose.fitting.floor import Floor
from pamctl.diagnose.fitting.repeatability import Repeat, find_repeats
from pamctl.diagnose.measured.record import CHANNELS, Array, Record
from pamctl.diagnose.measured.sensor_noise import Noise, estimate_channel_noise
from pamctl.plant.model import PlantSettings

SMALLEST_MISFIT = {"pressure_pa": 60.0, "position_m": 3.2e-6}
"""A misfit below is of no interest, however significant; by channel."""


@dataclass(frozen=True)
class Evidence:
    """Records prepared for every block that they can drive."""

    nominal: PlantSettings
    train: dict[str, tuple[Drive, ...]]
    """Drives to fit on, by block."""
    holdout: dict[str, tuple[Drive, ...]]
    """Drives to judge by."""
    noises: dict[str, Noise]
    """By channel."""
    together: Mapping[str, tuple[Drive, ...]] = field(default_factory=dict)
    """The training drives as a fit of both blocks counts them; empty where none is made."""
    repeated: tuple[Repeat, ...] = ()
    """Where the same commands come again; records counted through `train`, then `holdout`."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """The blocks that these records can drive."""
        return tuple(self.train)

    def margin(self, block: str) -> float:
        """Return the smallest misfit that matters, counted as the block's residuals are."""
        drive = self.train[block][0]
        channel = "pressure_pa" if block == PRESSURE else "position_m"
        # Of a poor sensor a fifth of its noise.
        return max(SMALLEST_MISFIT[channel], 0.2 * self.noises[channel].total) / drive.deviation

    def weigh_by_floors(self, floors: Mapping[str, Floor]) -> Evidence:
        """Return the evidence with each block's residuals counted by what they are worth.

        A fit of both blocks weighs them by it. The mechanics' floor is several counts of the
        encoder, and slow: counted in deviations of the sensor it would outweigh a pressure whose
        noise forgets at once, and bend to itself what both share.
        """

        def recounted(block: str, drives: Sequence[Drive]) -> tuple[Drive, ...]:
            worth = floors[block].mean * float(np.sqrt(floors[block].memory))
            return tuple(replace(d, deviation=d.deviation * worth) for d in drives)

        return replace(self, together={b: recounted(b, d) for b, d in self.train.items()})

    def training_drives(self, blocks: Collection[str]) -> tuple[Drive, ...]:
        """Return the drives that a fit of these blocks goes by."""
        drives = self.together if self.together and len(blocks) > 1 else self.train
        return tuple(d for b in self.blocks if b in blocks for d in drives[b])

    def select_blocks(self, blocks: Collection[str]) -> Evidence:
        """Return the evidence of some of the blocks."""
        return replace(
            self,
            train={b: d for b, d in self.train.items() if b in blocks},
            together={},
            holdout={b: d for b, d in self.holdout.items() if b in blocks},
        )


def prepare_evidence(
    train: Sequence[Record], holdout: Sequence[Record], nominal: PlantSettings
) -> Evidence:
    """Prepare records; noise is estimated from all of them together."""
    everything = [*train, *holdout]
    noises = {
        channel: estimate_channel_noise(everything, channel)
        for channel in CHANNELS
        if channel != "valve_v" and channel in everything[0].channels
    }
    measured = everything[0].channels
    # A single run that is cut is in both parts, and no repeat of itself.
    different = [*train, *(r for r in holdout if all(r is not t for t in train))]
    evidence = Evidence(nominal, {}, {}, noises, repeated=find_repeats(different))
    drivers: dict[str, Callable[[Record], Drive]] = {}
    atmosphere_pa = nominal.parameters.atmospheric_pressure_pa
    if nominal.actuator == "direct":
        if {"force_n", "position_m"} <= {*measured}:
            drivers[MECHANICS] = lambda record: prepare_force_drive(record, noises)
    else:
        if {"valve_v", "pressure_pa"} <= {*measured}:
            drivers[PRESSURE] = lambda record: prepare_pressure_drive(record, noises, atmosphere_pa)
        if {"position_m", "pressure_pa"} <= {*measured}:
            drivers[MECHANICS] = lambda record: prepare_mechanics_drive(record, noises)
    for block, driver in drivers.items():
        evidence.train[block] = tuple(map(driver, train))
        evidence.holdout[block] = tuple(map(driver, holdout))
    return evidence


def with_modelled_pressure(
    evidence: Evidence,
    train: Sequence[Record],
    holdout: Sequence[Record],
    pressure_model: PlantSettings,
    *,
    trusted: bool,
) -> Evidence:
    """Drive the mechanics by the pressure block's account of the measured pressure.

    Where the account is trusted, being at its floor, hardly any sensor noise is left.
    """
    cutoff_hz = MODELLED_HZ if trusted else SMOOTH_HZ

    def driven_by(record: Record, pressure: Drive) -> Drive:
        modelled_pa = _hold_rest_pressure(pressure.simulate(pressure_model), record.rest_samples)
        drive = prepare_mechanics_drive(record, evidence.noises, modelled_pa, cutoff_hz)
        gauge_pa = pressure.resting_gauge_pa(pressure_model, record.rest_samples) if trusted else 0
        moved_m = contraction_m(evidence.nominal, gauge_pa) if gauge_pa > 0.0 else 0.0
        if drive.start or moved_m <= drive.slack:
            return drive
        # The encoder was zeroed where the muscle rested, and a leak held that up a little.
        return replace(drive, start=moved_m, slack=moved_m)

    def driven(records: Sequence[Record], drives: Sequence[Drive]) -> tuple[Drive, ...]:
        return tuple(driven_by(r, d) for r, d in zip(records, drives, strict=True))

    return replace(
        evidence,
        train={**evidence.train, MECHANICS: driven(train, evidence.train[PRESSURE])},
        holdout={**evidence.holdout, MECHANICS: driven(holdout, evidence.holdout[PRESSURE])},
    )


def _hold_rest_pressure(pressure_pa: Array, samples: int) -> Array:
    """Let a model that began at the atmosphere's pressure rest where it came to rest."""
    if not samples:
        return pressure_pa
    steady_pa = pressure_pa.copy()
    steady_pa[:samples] = np.median(pressure_pa[samples // 2 : samples])
    return steady_pa
