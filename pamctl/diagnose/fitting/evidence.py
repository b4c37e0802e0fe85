"""The evidence of a diagnosis: the drives of both blocks, and the sensors' noise."""

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
    has_constant_volume,
    prepare_force_drive,
    prepare_mechanics_drive,
    prepare_pressure_drive,
)
from pamctl.diagnose.fitting.floor import Floor
from pamctl.diagnose.fitting.repeatability import Repeat, find_repeats
from pamctl.diagnose.judging.judges import (
    Judge,
    JudgeKind,
    choose_slope_s,
    judge_chamber,
    judge_mechanism,
    judge_muscle,
)
from pamctl.diagnose.measured.noise.filtering import find_filtering
from pamctl.diagnose.measured.noise.sensor_noise import Noise, estimate_channel_noise
from pamctl.diagnose.measured.reach import Reach, measure_reach
from pamctl.diagnose.measured.record import CHANNELS, Array, Record
from pamctl.plant.model import PlantSettings, values_of

PISTON = "piston.area_m2"
"""The number by which a measured pressure drives a direct mechanism."""
SMALLEST_MISFIT = {"pressure_pa": 60.0, "position_m": 3.2e-6, "force_n": 1e-3}
"""A smaller misfit does not matter, even if it is significant; by channel, in SI."""


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
    """Training drives for a fit of both blocks, weighed against each other; may be empty."""
    judge: Mapping[str, Judge] = field(default_factory=dict)
    """How each block is judged: free run, windows or equation."""
    balance: tuple[Drive, ...] = ()
    """Training drives of the mechanics as an equation, where a force was measured: a fit of them
    needs no simulation, and finds a start from any guess."""
    repeated: tuple[Repeat, ...] = ()
    """Where the same commands come again; records are numbered through `train`, then `holdout`."""

    reach: Reach | None = None
    """How far a direct mechanism's records reach; None for a muscle."""

    filtered: frozenset[str] = frozenset()
    """Channels that look as if somebody had filtered them."""

    doubted: frozenset[str] = frozenset()
    """Blocks whose estimated limit hid something: what is left below it was no noise."""

    strict: frozenset[str] = frozenset()
    """Blocks that are judged without a margin, since they leave more than noise below it."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """The blocks that these records can drive."""
        return tuple(self.train)

    def margin(self, block: str) -> float:
        """Return the smallest misfit that matters, in the unit of the block's residuals."""
        if block in self.strict:
            return 0.0
        drive = self.train[block][0]
        noise = self.noises[drive.channel]
        smallest = SMALLEST_MISFIT[drive.channel]
        if self.nominal.actuator != "muscle":  # of any size: what its own sensor can show
            smallest = noise.resolution
        # For a poor sensor: a fifth of its noise.
        return max(smallest, 0.2 * noise.total) / drive.deviation

    def weigh_by_floors(self, floors: Mapping[str, Floor]) -> Evidence:
        """Return the evidence with weights for a fit of both blocks.

        The mechanics' floor is several counts of the encoder, and slow. In deviations of the
        sensor it would outweigh the pressure, whose noise is white, and distort what both share.
        """

        def weigh_drives(block: str, drives: Sequence[Drive]) -> tuple[Drive, ...]:
            weight = floors[block].mean * float(np.sqrt(floors[block].memory))
            return tuple(replace(d, deviation=d.deviation * weight) for d in drives)

        return replace(self, together={b: weigh_drives(b, d) for b, d in self.train.items()})

    def training_drives(self, blocks: Collection[str]) -> tuple[Drive, ...]:
        """Return the drives for a fit of these blocks."""
        drives = self.together if self.together and len(blocks) > 1 else self.train
        return tuple(d for b in self.blocks if b in blocks for d in drives[b])

    def select_blocks(self, blocks: Collection[str]) -> Evidence:
        """Return the evidence of some of the blocks."""
        return replace(
            self,
            train={b: d for b, d in self.train.items() if b in blocks},
            together={},
            judge={b: j for b, j in self.judge.items() if b in blocks},
            holdout={b: d for b, d in self.holdout.items() if b in blocks},
        )


def prepare_evidence(
    train: Sequence[Record], holdout: Sequence[Record], nominal: PlantSettings
) -> Evidence:
    """Prepare records; noise is estimated from all of them together."""
    records = [*train, *holdout]
    measured = records[0].channels
    noises = {
        channel: estimate_channel_noise(records, channel)
        for channel in CHANNELS
        if channel != "valve_v" and channel in measured
    }
    # A single run that is cut is in both lists; it does not repeat itself.
    different = [*train, *(r for r in holdout if all(r is not t for t in train))]
    reach = None
    if nominal.actuator == "direct" and "position_m" in noises:
        position = noises["position_m"]
        reach = measure_reach(records, nominal, position.deviation, position.resolution)
    filtered = frozenset(c for c in noises if find_filtering(records, c) is not None)
    repeated = find_repeats(different)
    evidence = Evidence(nominal, {}, {}, noises, repeated=repeated, reach=reach, filtered=filtered)
    preparers: dict[str, Callable[[Record], Drive]] = {}
    judge: dict[str, Judge] = {}
    if nominal.actuator == "direct":
        presses = "pressure_pa" in measured and PISTON in values_of(nominal)
        if "position_m" in measured and ("force_n" in measured or presses):
            of_axis = judge[MECHANICS] = judge_mechanism(records, noises)
            preparers[MECHANICS] = lambda record: prepare_force_drive(record, noises, of_axis)
            evidence = replace(evidence, balance=_prepare_balance(train, records, noises))
    else:
        is_closed = has_constant_volume(nominal) and "valve_v" not in measured
        if "pressure_pa" in measured and ("valve_v" in measured or is_closed):
            of_air = judge[PRESSURE] = judge_chamber(records)
            preparers[PRESSURE] = lambda record: prepare_pressure_drive(
                record, noises, nominal, of_air
            )
        if {"position_m", "pressure_pa"} <= {*measured} and not has_constant_volume(nominal):
            of_muscle = judge[MECHANICS] = judge_muscle(records)
            preparers[MECHANICS] = lambda record: prepare_mechanics_drive(
                record, noises, judge=of_muscle
            )
    evidence = replace(evidence, judge=judge)
    for block, prepare in preparers.items():
        evidence.train[block] = tuple(map(prepare, train))
        evidence.holdout[block] = tuple(map(prepare, holdout))
    return evidence


def _prepare_balance(
    train: Sequence[Record], records: Sequence[Record], noises: dict[str, Noise]
) -> tuple[Drive, ...]:
    """Prepare the training records as an equation; none without a force."""
    if "force_n" not in noises:
        return ()
    slope_s = choose_slope_s(records, noises["position_m"], 2)
    judge = Judge(JudgeKind.EQUATION, "to find a start", slope_s=slope_s)
    return tuple(prepare_force_drive(record, noises, judge) for record in train)


def with_modelled_pressure(
    evidence: Evidence,
    train: Sequence[Record],
    holdout: Sequence[Record],
    pressure_model: PlantSettings,
    *,
    trusted: bool,
    is_near: bool = False,
) -> Evidence:
    """Drive the mechanics with the pressure block's simulation of the measured pressure.

    If the simulation is trusted, because it is at its floor, hardly any sensor noise is left. One
    that `is_near` is good enough to say at which pressure the encoder was zeroed.
    """
    cutoff_hz = MODELLED_HZ if trusted else SMOOTH_HZ

    def prepare_drive(record: Record, pressure: Drive) -> Drive:
        true_pa = pressure.without_filter().simulate(pressure_model)
        modelled_pa = _hold_rest_pressure(true_pa, record.rest_samples)
        drive = prepare_mechanics_drive(
            record, evidence.noises, modelled_pa, cutoff_hz, evidence.judge[MECHANICS]
        )
        drive = replace(drive, bend=pressure.find_bend(pressure_model), part=pressure.part)
        gauge_pa = 0.0
        if trusted or is_near:
            gauge_pa = pressure.resting_gauge_pa(pressure_model, record.rest_samples)
        moved_m = contraction_m(evidence.nominal, gauge_pa) if gauge_pa > 0.0 else 0.0
        if drive.start or moved_m <= drive.slack:
            return drive
        # The encoder was zeroed while a leak kept the muscle slightly contracted.
        return replace(drive, start=moved_m, slack=moved_m)

    def prepare_drives(records: Sequence[Record], drives: Sequence[Drive]) -> tuple[Drive, ...]:
        return tuple(prepare_drive(r, d) for r, d in zip(records, drives, strict=True))

    return replace(
        evidence,
        train={**evidence.train, MECHANICS: prepare_drives(train, evidence.train[PRESSURE])},
        holdout={
            **evidence.holdout,
            MECHANICS: prepare_drives(holdout, evidence.holdout[PRESSURE]),
        },
    )


def _hold_rest_pressure(pressure_pa: Array, samples: int) -> Array:
    """Replace the rest at the start by the pressure at which the model settles there."""
    if not samples:
        return pressure_pa
    steady_pa = pressure_pa.copy()
    steady_pa[:samples] = np.median(pressure_pa[samples // 2 : samples])
    return steady_pa
