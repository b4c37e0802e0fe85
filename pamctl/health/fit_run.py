"""One run: the numbers of its plant with intervals, and what they leave unexplained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import hypot
from pathlib import Path

import numpy as np

from pamctl.diagnose.evidence.ladder import fit_number
from pamctl.diagnose.evidence.pool import CHAIN
from pamctl.diagnose.evidence.weigh import prepare_weigher
from pamctl.diagnose.measured.from_log import record_of
from pamctl.diagnose.measured.noise.mend import mend_records
from pamctl.diagnose.measured.noise.sensor_noise import estimate_channel_noise
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.measured.refuse import BadData, check_measured_runs, check_sensors
from pamctl.diagnose.plant_numbers import FittedNumber
from pamctl.log.framing import LogError
from pamctl.plant.model import PlantSettings

PRESSURE = "pressure"
MISFIT = " misfit"
"""Ends the name of a channel's misfit, which is followed like a number."""
MISFIT_SCATTER = 0.15
"""Relative half width of a misfit over its sensor's noise."""
PRESSURE_SCATTER = 0.05
"""Half width of the pressure's misfit where the model explains it: runs of an unchanged rig differ
by 0.06 of the noise at most (140 runs of 35 hidden rigs); those of the position by 0.4."""
SHORTEST_S = 3.0


@dataclass(frozen=True)
class FittedRun:
    """A run with its numbers; or why it has none."""

    name: str
    when_s: float
    experiment: str = ""
    numbers: Mapping[str, FittedNumber] = field(default_factory=dict)
    """Fitted numbers by name, and the misfit of each channel, over its sensor's noise.

    Less than the noise says only that this run's was taken for larger than it is: it counts as 1.
    """
    refused: str = ""


def fit_log(path: Path, when_s: float, plant: PlantSettings) -> FittedRun:
    """Fit a log; a log that cannot be used is returned with the reason."""
    try:
        record = record_of(path)
        return replace(fit_record(record, plant), name=path.name, when_s=when_s)
    except (LogError, BadData, OSError) as error:
        return FittedRun(path.name, when_s, refused=" ".join(str(error).split()))


def fit_record(record: Record, plant: PlantSettings) -> FittedRun:
    """Fit a record; raise `BadData` where it cannot be fitted."""
    (record,), _ = mend_records([record])
    if plant.noise is not None:
        record = replace(record, stated_noise={**record.stated_noise, **plant.noise.stated})
    if record.duration_s < SHORTEST_S:
        raise BadData(f"{record.duration_s:.1f} s after homing; {SHORTEST_S:g} s are needed")
    check_measured_runs([record], plant, None)
    noises = {c: estimate_channel_noise([record], c) for c in record.channels if c != "valve_v"}
    check_sensors([record], noises, plant, None)
    try:
        weigher, start = prepare_weigher([record], (), plant)
    except ValueError as error:
        raise BadData(str(error)) from None
    m = weigher.settle(start)
    left2 = weigher.like.mean_squares(m.d) / weigher.find_noise2(m)
    ratios = {
        channel.split("_")[0]: max(float(ratio), 1.0)
        for channel, ratio in zip(weigher.train.channels, np.sqrt(left2), strict=True)
    }
    numbers = {
        name: _widen_by_misfit(fit_number(name, m.values[name], ends), max(ratios.values()))
        for name, ends in weigher.find_intervals(m).items()
        if not name.startswith(CHAIN)
    }
    for short, ratio in ratios.items():
        half = MISFIT_SCATTER * ratio
        if short == PRESSURE:
            half = hypot(PRESSURE_SCATTER, MISFIT_SCATTER * (ratio - 1.0))
        name = short + MISFIT
        numbers[name] = FittedNumber(name, ratio, ratio - half, ratio + half, "x noise")
    return FittedRun(record.name, 0.0, record.experiment, numbers)


def _widen_by_misfit(number: FittedNumber, ratio: float) -> FittedNumber:
    """Widen an interval by what is left beyond a misfit's scatter: what is left moves numbers."""
    factor = max(ratio / (1.0 + MISFIT_SCATTER), 1.0)
    low, high = (number.value + factor * (end - number.value) for end in (number.low, number.high))
    return replace(number, low=low, high=high)


def fit_halves(path: Path, plant: PlantSettings) -> tuple[FittedRun, FittedRun] | None:
    """Fit the halves of a log; None where one cannot be fitted."""
    try:
        record = record_of(path)
        middle = len(record) // 2
        parts = (record.cut_samples(0, middle, "a"), record.cut_samples(middle, len(record), "b"))
        first, second = (replace(part, t_s=part.t_s - part.t_s[0]) for part in parts)
        return fit_record(first, plant), fit_record(second, plant)
    except (LogError, BadData, OSError):
        return None
