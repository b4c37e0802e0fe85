"""One run: the numbers of its plant with intervals, and what they leave unexplained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import hypot
from pathlib import Path

from pamctl.diagnose.fitting.drives import PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.intervals import FittedNumber, estimate_intervals
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.fitting.numbers import calibration_of
from pamctl.diagnose.measured.from_log import record_of
from pamctl.diagnose.measured.noise.mend import mend_records
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.measured.refuse import BadData, check_measured_runs, check_sensors
from pamctl.log.framing import LogError
from pamctl.plant.model import PlantSettings

MISFIT = " misfit"
"""Ends the name of a block's misfit, which is followed like a number."""
MISFIT_SCATTER = 0.15
"""Relative half width of a misfit over its floor."""
PRESSURE_SCATTER = 0.05
"""Half width of the pressure's misfit where the model explains it: runs of an unchanged rig differ
by 0.06 of the floor at most (140 runs of 35 hidden rigs); those of the mechanics by 0.4."""
SHORTEST_S = 3.0


@dataclass(frozen=True)
class FittedRun:
    """A run with its numbers; or why it has none."""

    name: str
    when_s: float
    experiment: str = ""
    numbers: Mapping[str, FittedNumber] = field(default_factory=dict)
    """Fitted numbers by name, and the misfit of each block, over its floor.

    Less than the floor says only that this run's noise was taken for larger than it is: it counts
    as the floor.
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
    evidence = prepare_evidence([record], [record], plant)
    if not evidence.blocks:
        raise BadData("it holds no pressure with the valve's command or the position")
    check_sensors([record], evidence.noises, plant, None)
    model = recalibrate(evidence)
    ratios = {block: max(model.ratio(block), 1.0) for block in evidence.blocks}
    numbers = {n.name: _widen_by_misfit(n, ratios, plant) for n in estimate_intervals(model)}
    for block, ratio in ratios.items():
        half = MISFIT_SCATTER * ratio
        if block == PRESSURE:
            half = hypot(PRESSURE_SCATTER, MISFIT_SCATTER * (ratio - 1.0))
        name = block + MISFIT
        numbers[name] = FittedNumber(name, ratio, ratio - half, ratio + half, "x floor")
    return FittedRun(record.name, 0.0, record.experiment, numbers)


def _widen_by_misfit(
    number: FittedNumber, ratios: Mapping[str, float], plant: PlantSettings
) -> FittedNumber:
    """Widen an interval by what its block leaves beyond the scatter of a floor.

    What is left moves numbers too.
    """
    own = [ratio for block, ratio in ratios.items() if number.name in calibration_of(block, plant)]
    factor = max(max(own or ratios.values()) / (1.0 + MISFIT_SCATTER), 1.0)
    value = number.value
    low, high = (value + factor * (end - value) for end in (number.low, number.high))
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
