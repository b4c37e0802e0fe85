"""Grey-box models with residual tests, as one builds them with an identification toolbox.

One structure an effect: the differential equations of a block with the effect in it, simulated
under the other block's measured signal (output error) and fitted by bounded least squares with
finite differences. The structure with the lowest BIC is taken, up to two effects a block, while
the residual on the held-out records is no good: it is where it is below the sensor's own step or
noise, or passes the two usual tests, its own whiteness and its independence of the input.

The equations and the list of effects are pamctl's own plant and catalogue: a user who has written
35 structures by hand has no better ones. What is compared is the method around them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from block_rows import Array, Record
from naming import CLEAR, HELD_OUT_GAIN, make_verdict
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from pamctl.diagnose.fitting.numbers import (
    FreeNumber,
    calibrated_number,
    calibration_of,
    numbers_of_effect,
    sensor_zero,
    value_of,
    with_values,
)
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.drive import drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters

MOST_EFFECTS = 2
MOST_EVALUATIONS = 12
"""Of a fit, each with its finite differences; most fits end after four."""
STEP = 1e-3
"""Of a finite difference, as a share of a number's scale of a tenth of its limits."""
SMOOTH_S = 0.015
"""A measured pressure that drives the mechanics is smoothed: friction rectifies its noise."""
ENOUGH = 1.5
"""A residual so many times a sensor's step or noise needs no further effect."""
LAGS = 25
CONFIDENCE = 2.58
"""99 %, as `resid` draws it."""
FAILING = 0.2
"""Share of the lags outside the band that fails a test: an ADC's steps alone put some there."""


@dataclass(frozen=True)
class Structure:
    """A model structure with numbers that were fitted."""

    effects: tuple[str, ...]
    settings: PlantSettings
    free: tuple[FreeNumber, ...]
    left: Array
    """Residual on the training records."""
    held_out: Array
    bic: float


@dataclass(frozen=True)
class Data:
    """The records of one block."""

    block: str
    train: Sequence[Record]
    held_out: Sequence[Record]


def diagnose_task(task: Any) -> dict[str, Any]:
    """Return a verdict on a task of the benchmark."""
    if not {"pressure_pa", "position_m"} <= {*task.train[0]}:
        return make_verdict([], discrepancy=False, sure=True)
    blocks = ["pressure", "mechanics"] if "valve_v" in task.train[0] else ["mechanics"]
    start = PlantSettings.model_validate(task.card["start_model"])
    left_out = {*task.card["names_not_to_use"]}
    groups: list[list[str]] = []
    discrepancy = False
    sure = True
    for block in blocks:
        data = Data(block, task.train, task.held_out)
        recalibrated = fit_structure(data, start, (), calibrate(block, start), {})
        if is_good(data, recalibrated):
            continue
        found, best = select_structures(data, recalibrated, left_out)
        groups += found
        discrepancy = discrepancy or bool(found)
        sure = sure and is_good(data, best)
    return make_verdict(groups, discrepancy=discrepancy, sure=sure)


def calibrate(block: str, start: PlantSettings) -> tuple[FreeNumber, ...]:
    """Return the numbers of the start model that every structure of a block may move."""
    zero = (sensor_zero(start),) if block == "mechanics" else ()
    return (*(calibrated_number(name, start) for name in calibration_of(block, start)), *zero)


def select_structures(
    data: Data, start: Structure, left_out: set[str]
) -> tuple[list[list[str]], Structure]:
    """Return the effects that BIC adds one by one, and the best structure.

    A group of several cannot be told apart.
    """
    best, groups = start, []
    while len(groups) < MOST_EFFECTS and not is_good(data, best):
        tried = [*_widen(data, best, left_out)]
        if not tried:
            break
        widest = min(tried, key=lambda one: one.bic)
        if widest.bic > best.bic - CLEAR or not _gains(start, best, widest):
            break
        groups.append(sorted({s.effects[-1] for s in tried if s.bic < widest.bic + CLEAR}))
        best = widest
    return groups, best


def _gains(start: Structure, before: Structure, after: Structure) -> bool:
    left = [float(np.mean(one.held_out**2)) for one in (start, before, after)]
    return left[1] - left[2] > HELD_OUT_GAIN * left[0]


def _widen(data: Data, before: Structure, left_out: set[str]) -> Iterator[Structure]:
    """Yield the structure with one more effect, for each that acts on the block, in each form."""
    for name, effect in CATALOGUE.items():
        if name in {*before.effects, *left_out} or data.block not in effect.seen_by:
            continue
        if "muscle" not in effect.actuators or effect.unidentifiable:
            continue
        every = tuple(p.name for p in effect.parameters)
        for names, held in [(f.free, f.held) for f in effect.forms] or [(every, {})]:
            numbers = numbers_of_effect(name, names, before.settings)
            fixed = {f"{name}.{number}": value for number, value in held.items()}
            free = (*before.free, *numbers)
            yield fit_structure(data, before.settings, (*before.effects, name), free, fixed)


def fit_structure(
    data: Data,
    settings: PlantSettings,
    effects: tuple[str, ...],
    free: tuple[FreeNumber, ...],
    fixed: Mapping[str, float],
) -> Structure:
    """Fit a structure from the numbers that are known, and the usual ones of a new effect."""
    low, high = (np.array([getattr(f, side) for f in free]) for side in ("low", "high"))
    span = 0.1 * (high - low)
    new = effects[-1] if effects else None

    def start_of(number: FreeNumber) -> float:
        known = number.effect != new or number.usual is None
        return value_of(settings, number.name) if known else float(number.usual or 0.0)

    first = np.clip([start_of(f) for f in free], low + 1e-3 * span, high - 1e-3 * span)

    def build(values: Array) -> PlantSettings:
        numbers = zip((f.name for f in free), values.tolist(), strict=True)
        return with_values(settings, {**fixed, **dict(numbers)})

    def residual(scaled: Array) -> Array:
        return simulate_residual(data.block, build(scaled * span), data.train)

    fitted = least_squares(
        residual,
        first / span,
        bounds=(low / span, high / span),
        x_scale=1.0,
        method="trf",
        max_nfev=MOST_EVALUATIONS,
        jac=lambda at: _difference(residual, at, high / span),
    )
    best = build(fitted.x * span)
    left = np.asarray(fitted.fun)
    bic = len(left) * np.log(np.mean(left**2)) + len(free) * np.log(len(left))
    held_out = simulate_residual(data.block, best, data.held_out)
    return Structure(effects, best, free, left, held_out, float(bic))


def _difference(residual: Any, at: Array, high: Array) -> Array:
    """Return a forward difference for each number, backward at its upper limit."""
    middle = residual(at)
    columns = []
    for k in range(len(at)):
        moved = at.copy()
        moved[k] += STEP if at[k] + STEP < high[k] else -STEP
        columns.append((residual(moved) - middle) / (moved[k] - at[k]))
    return np.stack(columns, axis=1)


def simulate_residual(block: str, settings: PlantSettings, records: Sequence[Record]) -> Array:
    """Return measured minus simulated output over all records, in SI."""
    p = plant_parameters(settings)
    return np.concatenate([_simulate_one(block, p, record) for record in records])


def _simulate_one(block: str, p: Any, record: Record) -> Array:
    dt = np.diff(record["t_s"])
    position, pressure = record["position_m"], record["pressure_pa"]
    if block == "pressure":
        left = pressure - drive_pressure(p, record["valve_v"], position, dt).pressure_pa
    else:
        rows = round(SMOOTH_S / float(np.median(dt))) | 1
        left = position - drive_mechanics(p, savgol_filter(pressure, rows, 3), dt).position_m
    return np.nan_to_num(np.clip(left, -1e6, 1e6), nan=1e6)


def is_good(data: Data, structure: Structure) -> bool:
    """Tell whether the held-out residual is as small as the sensor's, or passes the two tests.

    A good model of a coarse encoder never passes them: the encoder's steps are not white.
    """
    column = "pressure_pa" if data.block == "pressure" else "position_m"
    unit = max(_resolve(record[column]) for record in data.held_out)
    rms = float(np.sqrt(np.mean(structure.held_out**2)))
    return rms < ENOUGH * unit or passes_residual_tests(data, structure)


def _resolve(values: Array) -> float:
    """Return a sensor's step, or its noise where that is larger."""
    moved, bent = (np.abs(np.diff(values, n)) for n in (1, 2))
    noise = 1.4826 * float(np.median(bent)) / np.sqrt(6.0)
    return max(float(moved[moved > 1e-9 * np.ptp(values)].min()), noise)


def passes_residual_tests(data: Data, structure: Structure) -> bool:
    """Tell whether the held-out residual is white, and independent of the block's input."""
    ends = np.cumsum([len(record["t_s"]) for record in data.held_out])[:-1]
    column = "valve_v" if data.block == "pressure" else "pressure_pa"
    parts = np.split(structure.held_out, ends)
    return all(
        _share_outside(left, left, first=1) < FAILING
        and _share_outside(left, record[column], first=0) < FAILING
        for left, record in zip(parts, data.held_out, strict=True)
    )


def _share_outside(left: Array, other: Array, first: int) -> float:
    """Return the share of the lags at which a correlation leaves the band of independence."""
    a, b = left - left.mean(), other - other.mean()
    scale = max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    lags = range(first, LAGS + first)
    found = np.array([a[k:] @ b[: len(b) - k] for k in lags]) / scale
    return float(np.mean(np.abs(found) > CONFIDENCE / np.sqrt(len(a))))
