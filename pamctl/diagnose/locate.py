"""Where simulation and measurement disagree: by block, and by regime within it.

A misfit over a whole run may hide in a rare regime (the valve near null, a reversal), or be
carried by one. Each regime is compared with the same regime of the replicas, and of the many
comparisons only those stand out that noise would bring about in one of twenty at most.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter1d
from scipy.signal import savgol_filter
from scipy.stats import false_discovery_control
from scipy.stats import t as student

from pamctl.diagnose.fitting.drives import MECHANICS, Drive
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import imitate_records, sensor_noise_of
from pamctl.diagnose.measured.record import Array

Rows = NDArray[np.bool_]

FEWEST_SAMPLES = 100
"""Samples that make a regime."""
NULL_V = 0.5
SLOW_M_PER_S = 5e-4
CHOKED = 0.528
EVENLY = "spread evenly"
RATE = 0.05
"""Of what is said to stand out, the share that noise alone may have brought, in the mean."""


@dataclass(frozen=True)
class RegimeMisfit:
    """One regime of one block on the held-out records."""

    block: str
    regime: str
    share: float
    """Of the samples."""
    rms: float
    """In deviations of the sensor."""
    residual_over_floor: float
    """The floor is that of this regime: friction makes more noise in some than in others."""
    excess_share: float
    """Share of the block's whole misfit (square above the floor's) that lies here."""
    p_value: float
    """Chance that noise alone leaves as much here beyond what is too small to matter."""
    stands_out: bool = False
    """Of all regimes that stand out one in twenty may be noise, in the mean."""


def locate_misfits(model: Model) -> list[RegimeMisfit]:
    """Return every regime of every block, the worst of each block first."""
    every = [cell for block in model.evidence.blocks for cell in _locate_in_block(model, block)]
    found = flag_discoveries([cell.p_value for cell in every])
    return [replace(cell, stands_out=bool(out)) for cell, out in zip(every, found, strict=True)]


def _locate_in_block(model: Model, block: str) -> list[RegimeMisfit]:
    evidence = model.evidence
    drives = evidence.holdout[block]
    residual = model.residuals[block]
    noise = np.array(
        [
            made.residual
            for made in imitate_records(model.fit_for_floor(block), drives, evidence.noises)
        ]
    )
    floor = model.floors[block]
    # What the rig itself does differently each time is no misfit, in whichever regime.
    noise *= max(floor.repeatability / floor.mean, 1.0)
    trifle = evidence.margin(block) ** 2
    doubt = 2.0 * sensor_noise_of(drives, evidence.noises).uncertainty
    excess = float(np.sum(np.maximum(residual**2 - floor.mean**2, 0.0))) or 1.0
    masks: dict[str, list[Rows]] = {}
    for drive in drives:
        for name, rows in find_regimes(drive, model).items():
            masks.setdefault(name, []).append(rows if drive.rows is None else rows[drive.rows])
    found = []
    for name, parts in masks.items():
        rows = np.concatenate(parts)
        if rows.sum() < FEWEST_SAMPLES:
            continue
        part = residual[rows]
        level = float(np.mean(part**2))
        usual = np.mean(noise[:, rows] ** 2, axis=1)
        ratio = float(np.sqrt(level / np.mean(usual)))
        inside = float(np.sum(np.maximum(part**2 - floor.mean**2, 0.0))) / excess
        chance = exceedance(level - trifle, usual, doubt)
        share = float(rows.mean())
        found.append(RegimeMisfit(block, name, share, float(np.sqrt(level)), ratio, inside, chance))
    return sorted(found, key=lambda c: -c.residual_over_floor)


def find_regimes(drive: Drive, model: Model) -> Mapping[str, Rows]:
    """Return the regimes of a drive, each as the samples that are in it."""
    p = model.evidence.nominal.parameters
    period_s = float(np.median(drive.step_s))
    if drive.block == MECHANICS:
        gauge = drive.driven - p.atmospheric_pressure_pa
        return {
            **_find_motion_regimes(drive.measured, period_s),
            **_find_pressure_regimes(gauge, p.tank_pressure_pa - p.atmospheric_pressure_pa),
        }
    command = drive.valve_v
    ratio = np.where(
        command > 0.0,
        drive.measured / p.tank_pressure_pa,
        p.atmospheric_pressure_pa / np.maximum(drive.measured, 1.0),
    )
    stepped = np.abs(np.diff(command, prepend=command[0])) > NULL_V
    window = max(int(0.01 / period_s), 1)
    after = maximum_filter1d(stepped.astype(np.int8), 2 * window + 1, origin=-window) > 0
    closed = np.abs(command) < 0.02
    near = (np.abs(command) < NULL_V) & ~closed
    return {
        "valve closed": closed,
        "valve near null": near,
        "filling": (command >= NULL_V) & ~after,
        "exhausting": (command <= -NULL_V) & ~after,
        "within 10 ms of a step of the command": after,
        "choked flow": (ratio <= CHOKED) & ~closed,
        "flow not choked": (ratio > CHOKED) & ~closed,
        **_find_pressure_regimes(
            drive.measured - p.atmospheric_pressure_pa,
            p.tank_pressure_pa - p.atmospheric_pressure_pa,
        ),
    }


def _find_motion_regimes(position_m: Array, period_s: float) -> dict[str, Rows]:
    velocity = savgol_filter(position_m, 31, 2, deriv=1, delta=period_s)
    up, down = velocity > SLOW_M_PER_S, velocity < -SLOW_M_PER_S
    rest = ~up & ~down
    sign = np.sign(np.where(rest, 0.0, velocity))
    moving = sign[sign != 0.0]
    turned = np.zeros(len(sign), dtype=bool)
    turned[np.flatnonzero(sign != 0.0)[1:]] = np.diff(moving) != 0.0
    window = max(int(0.05 / period_s), 1)
    reversal = maximum_filter1d(turned.astype(np.int8), 2 * window + 1) > 0
    return {
        "contracting": up & ~reversal,
        "lengthening": down & ~reversal,
        "rest": rest & ~reversal,
        "reversal of the motion": reversal,
    }


def _find_pressure_regimes(gauge_pa: Array, full_pa: float) -> dict[str, Rows]:
    return {
        "low pressure": gauge_pa < full_pa / 3.0,
        "middle pressure": (gauge_pa >= full_pa / 3.0) & (gauge_pa < full_pa * 2.0 / 3.0),
        "high pressure": gauge_pa >= full_pa * 2.0 / 3.0,
    }


def describe_worst_regimes(found: Sequence[RegimeMisfit], block: str) -> str:
    """Say in words in which regimes a block's misfit lies: the worst two that stand out."""
    worst = [c for c in found if c.block == block and c.stands_out][:2]
    if not worst:
        return EVENLY
    return ", ".join(f"{c.regime} ({c.residual_over_floor:.1f} x floor)" for c in worst)


def flag_discoveries(p_values: ArrayLike, rate: float = RATE) -> NDArray[np.bool_]:
    """Tell which comparisons stand out, by Benjamini and Hochberg's step-up.

    It holds for regimes that share samples as well, since these go up and down together.
    """
    p = np.asarray(p_values, dtype=np.float64)
    found: NDArray[np.bool_] = false_discovery_control(p) <= rate if len(p) else p > 0.0
    return found


def exceedance(level: float, replicas: Array, doubt: float = 0.0) -> float:
    """Return the chance that what made `replicas` would once more give a level as high.

    Levels are mean squares, whose logarithms are near normal: Student's t of the next draw.
    `doubt` is how well the scale of the replicas is known itself, one sigma, relative.
    """
    logs = np.log(replicas)
    scatter = float(np.hypot(logs.std(ddof=1) * np.sqrt(1.0 + 1.0 / len(logs)), doubt))
    if level <= 0.0 or scatter == 0.0:
        return float(level <= np.exp(logs.mean()))
    return float(student.sf((np.log(level) - logs.mean()) / scatter, len(logs) - 1))
