"""How good a forecast was: what the refuted explanation really leaves of the program's run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import ValidationError

from pamctl.control.excitation import ForecastSettings
from pamctl.diagnose.measured.record import Record

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


def judge_forecasts(found, records):
    return ()
