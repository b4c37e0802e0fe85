"""How good a forecast was: what the refuted explanation really leaves of the program's run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from pamctl.control.experiment import ForecastSettings
from pamctl.diagnose.deciding.explanations import exchange_name, name_explanation
from pamctl.diagnose.deciding.separation import BLOCKS
from pamctl.diagnose.evidence.constants import COARSE_STEP_S
from pamctl.diagnose.evidence.fit import WeighedModel
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.run_pieces import Runs
from pamctl.diagnose.evidence.weigh import EvidenceVerdict
from pamctl.diagnose.measured.record import Record

GOOD = 2.0
"""A forecast within this factor of what was found was good."""


@dataclass(frozen=True)
class JudgedForecast:
    """One forecast, and what came of it."""

    record: str
    true: str
    """The explanation that was found in the end."""
    refuted: str
    block: str
    expected: float
    """Residual over the sensor's noise that the refuted one should leave of this record."""
    found: float | None
    """What it leaves; None where it was not fitted again."""

    @property
    def is_good(self) -> bool | None:
        """Whether both agree; None where nothing can be compared."""
        if self.found is None:
            return None
        return max(self.found / self.expected, self.expected / self.found) <= GOOD

    def as_dict(self) -> dict[str, Any]:
        """Return what the document holds."""
        return {**asdict(self), "is_good": self.is_good}


def read_forecast(record: Record) -> ForecastSettings | None:
    """Return the forecast that a record's program carried; None without a valid one."""
    keys = record.settings.get("experiment")
    forecast = keys.get("forecast") if isinstance(keys, Mapping) else None
    if forecast is None:
        return None
    try:
        return ForecastSettings.model_validate(forecast)
    except ValidationError:
        return None


def judge_forecasts(
    found: EvidenceVerdict, records: Sequence[Record]
) -> tuple[JudgedForecast, ...]:
    """Compare what was expected of each record with what its refuted explanations leave.

    A forecast is judged where the explanation that it took for true is the one that was found.
    """
    here, judged = name_explanation(found.model), []
    fitted: dict[str, WeighedModel | None] = {}
    for record in records:
        forecast = read_forecast(record)
        for pair in forecast.pairs if forecast else ():
            if pair.true != here:
                continue
            if pair.refuted not in fitted:
                fitted[pair.refuted] = _fit_again(found, pair.refuted)
            m = fitted[pair.refuted]
            left = None if m is None else _measure(found, m, pair.block, record)
            judged.append(
                JudgedForecast(
                    record.name, here, pair.refuted, pair.block, pair.residual_over_floor, left
                )
            )
    return tuple(judged)


def _fit_again(found: EvidenceVerdict, explanation: str) -> WeighedModel | None:
    """Return the model of an explanation, fitted to all records; None if it differs by far."""
    names = {*explanation.split(" and ")} - {"recalibration alone"}
    gone, new = {*found.model.names} - names, names - {*found.model.names}
    if len(gone) > 1 or len(new) > 1 or not new <= {*found.pool}:
        return None
    search = NameSearch(found.weigher, found.pool)
    return exchange_name(search, found.model, "".join(gone), "".join(new))


def _measure(found: EvidenceVerdict, m: WeighedModel, block: str, record: Record) -> float | None:
    """Return the RMS that a model leaves of one record, over the sensor's noise."""
    weigher = found.weigher
    channel = next((c for c, name in BLOCKS.items() if name == block), "")
    if channel not in weigher.train.channels:
        return None
    row = weigher.train.channels.index(channel)
    try:
        runs = Runs([record], weigher.base, weigher.train)
    except ValueError:  # shorter than a block
        return None
    off = runs.shown - runs.simulate({**weigher.base, **m.values}, COARSE_STEP_S)
    rms = float(np.sqrt((runs.fill_masked(off)[row] ** 2).mean()))
    return rms / float(np.sqrt(weigher.find_noise2(found.model)[row]))
