"""How good a forecast was: what the refuted explanation really leaves of the program's run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from pydantic import ValidationError

from pamctl.control.excitation import ForecastSettings
from pamctl.diagnose.deciding.explanations import name_explanation
from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.naming.rivals import Standing

GOOD = 1.5
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
    """Residual over floor that the refuted one should leave of this record."""
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
    model: Model, standings: Sequence[Standing], records: Sequence[Record]
) -> tuple[JudgedForecast, ...]:
    """Compare what was expected of each record with what its refuted explanations leave.

    A forecast is judged where the explanation that it took for true is the one that was found.
    """
    rivals = {name_explanation(m): m for s in standings for m in s.rival_models}
    return tuple(_judge(model, rivals, records))


def _judge(
    model: Model, rivals: Mapping[str, Model], records: Sequence[Record]
) -> Iterator[JudgedForecast]:
    here = name_explanation(model)
    for record in records:
        forecast = read_forecast(record)
        for pair in forecast.pairs if forecast else ():
            if pair.true != here or pair.block not in model.evidence.blocks:
                continue
            rival = rivals.get(pair.refuted)
            found = None if rival is None else _measure(rival, pair.block, record.name)
            yield JudgedForecast(
                record.name, here, pair.refuted, pair.block, pair.residual_over_floor, found
            )


def _measure(rival: Model, block: str, record: str) -> float | None:
    """Return what a model leaves of all samples of one record, over the block's floor."""
    evidence = rival.evidence
    for drive in (*evidence.train[block], *evidence.holdout[block]):
        if drive.name == record:
            residual = replace(drive, part=None).residual(rival.fit_of(block).settings)
            return rms(residual) / rival.floors[block].mean
    return None
