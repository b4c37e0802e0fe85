"""Step 2, locate: where simulation and measurement disagree, by block and by regime.

A misfit may lie in a rare regime: the valve near null, a reversal. Each regime is compared with
the same regime of the self-simulated replicas. The comparisons are many; on average at most one
in twenty of those that stand out is noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter1d
from scipy.special import stdtr

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.drives import MECHANICS, Drive
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import imitate_records, sensor_noise_of
from pamctl.diagnose.measured.record import Array

Rows = NDArray[np.bool_]

FEWEST_SAMPLES = 100
"""A regime with fewer samples is left out."""
NULL_V = 0.5
"""Smaller commands are near null (V)."""
SLOW_M_PER_S = 5e-4
"""Slower motion counts as rest."""
CHOKED = 0.528
"""Critical pressure ratio of air; flow below it is choked."""
EVENLY = "spread evenly"
RATE = 0.05
"""Share of the regimes that stand out which may be noise, on average."""


@dataclass(frozen=True)
class RegimeMisfit:
    """One regime of one block on the held-out records."""

    block: str
    regime: str
    share: float
    """Share of the samples."""
    rms: float
    """In deviations of the sensor."""
    residual_over_floor: float
    """Over this regime's own floor: friction makes more noise in some regimes than in others."""
    excess_share: float
    """Share of the block's whole misfit (squares above the floor's) that lies in this regime."""
    p_value: float
    """Chance that noise alone leaves as much, beyond what is too small to matter."""
    stands_out: bool = False
    """One in twenty regimes that stand out may be noise, on average."""


def locate_misfits(model: Model) -> list[RegimeMisfit]:
    """Return every regime of every block, the worst of each block first."""
    misfits = [m for block in model.evidence.blocks for m in _locate_in_block(model, block)]
    flags = flag_discoveries([misfit.p_value for misfit in misfits])
    return [replace(m, stands_out=bool(flag)) for m, flag in zip(misfits, flags, strict=True)]


def _locate_in_block(model: Model, block: str) -> list[RegimeMisfit]:
    evidence = model.evidence
    drives = evidence.holdout[block]
    residual = model.residuals[block]
    floor = model.floors[block]
    # What the rig does differently each time is no misfit in any regime.
    restless = max(floor.repeatability / floor.mean, 1.0)
    noise = draw_noise(model, block) * restless
    negligible = evidence.margin(block) ** 2
    uncertainty = 2.0 * sensor_noise_of(drives, evidence.noises).uncertainty
    excess = float(np.sum(np.maximum(residual**2 - floor.mean**2, 0.0))) or 1.0
    masks: dict[str, list[Rows]] = {}
    for drive in drives:
        for name, rows in find_regimes(drive, model).items():
            masks.setdefault(name, []).append(rows if drive.rows is None else rows[drive.rows])
    misfits = []
    for name, parts in masks.items():
        rows = np.concatenate(parts)
        if rows.sum() < FEWEST_SAMPLES:
            continue
        part = residual[rows]
        level = float(np.mean(part**2))
        usual = np.mean(noise[:, rows] ** 2, axis=1)
        ratio = float(np.sqrt(level / np.mean(usual)))
        inside = float(np.sum(np.maximum(part**2 - floor.mean**2, 0.0))) / excess
        chance = exceedance(level - negligible, usual, uncertainty)
        share = float(rows.mean())
        misfits.append(
            RegimeMisfit(block, name, share, float(np.sqrt(level)), ratio, inside, chance)
        )
    return sorted(misfits, key=lambda c: -c.residual_over_floor)


def draw_noise(model: Model, block: str) -> Array:
    """Return held-out residuals that noise alone leaves of a block, shape (replicas, samples).

    In deviations of the sensor. Models that share a fit share them. Where the sensor's noise is
    unknown, it is as large as the floor: its drawn size was arbitrary.
    """
    evidence, floor = model.evidence, model.floors[block]
    made = imitate_records(model.fit_for_floor(block), evidence.holdout[block], evidence.noises)
    noise = made.residuals
    return noise * (floor.mean / rms(noise)) if floor.is_estimate else noise


def find_regimes(drive: Drive, model: Model) -> Mapping[str, Rows]:
    """Return the regimes of a drive, each as a mask of its samples, shape (n,)."""
    p = model.evidence.nominal.parameters
    period_s = float(np.median(drive.step_s))
    if drive.block == MECHANICS:
        motion = _find_motion_regimes(drive.velocity_m_per_s, period_s)
        if model.evidence.nominal.actuator == "direct":
            return motion
        gauge = drive.driven - p.atmospheric_pressure_pa
        return {
            **motion,
            **_find_pressure_regimes(gauge, p.tank_pressure_pa - p.atmospheric_pressure_pa),
        }
    command = drive.valve_v
    ratio = np.where(
        command > 0.0,
        drive.measured / p.tank_pressure_pa,
        p.atmospheric_pressure_pa / np.maximum(drive.measured, 1.0),
    )
    stepped = np.abs(np.diff(command, prepend=command[0])) > NULL_V
    window = max(round(0.01 / period_s), 1)
    after = np.convolve(stepped, np.ones(window))[: len(stepped)] > 0.5
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


def _find_motion_regimes(velocity: Array, period_s: float) -> dict[str, Rows]:
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


def describe_worst_regimes(misfits: Sequence[RegimeMisfit], block: str) -> str:
    """Name the regimes of a block's misfit: the worst two that stand out."""
    worst = [c for c in misfits if c.block == block and c.stands_out][:2]
    if not worst:
        return EVENLY
    return ", ".join(f"{c.regime} ({c.residual_over_floor:.1f} x floor)" for c in worst)


def flag_discoveries(p_values: ArrayLike, rate: float = RATE) -> NDArray[np.bool_]:
    """Tell which comparisons stand out, by Benjamini and Hochberg's step-up.

    It also holds for regimes that share samples, since their levels are positively correlated.
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p)
    below = np.flatnonzero(p[order] <= rate * np.arange(1, len(p) + 1) / max(len(p), 1))
    flags = np.zeros(len(p), dtype=np.bool_)
    flags[order[: below[-1] + 1 if len(below) else 0]] = True
    return flags


def exceedance(level: float, replicas: Array, uncertainty: float = 0.0) -> float:
    """Return the chance that another replica has a level at least this high.

    Levels are mean squares, and their logarithms are nearly normal: Student's t of the next draw.
    `uncertainty` is that of the replicas' own scale, relative, one sigma.
    """
    logs = np.log(replicas)
    scatter = float(np.hypot(logs.std(ddof=1) * np.sqrt(1.0 + 1.0 / len(logs)), uncertainty))
    if level <= 0.0 or scatter == 0.0:
        return float(level <= np.exp(logs.mean()))
    return float(stdtr(len(logs) - 1, -(np.log(level) - logs.mean()) / scatter))
