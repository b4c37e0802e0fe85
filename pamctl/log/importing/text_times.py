"""Read times as programs write them for people: `2026-05-01T09:30:00.125`, `09:30:00,125`.

A day is named by its date as ISO 8601 or as `01.05.2026`. With another date, as `5/1/2026`, whose
order of day and month is not known, or with none, the clock counts on past midnight.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date

import numpy as np

from pamctl.log.importing.measured_table import Floats

_CLOCK = re.compile(
    r"(?:(?P<iso>\d{4}[-/]\d{1,2}[-/]\d{1,2})|(?P<dots>\d{1,2}\.\d{1,2}\.\d{4})"
    r"|\d{1,2}/\d{1,2}/\d{2,4})?[T\s]*"
    r"(?P<h>\d{1,3}):(?P<m>[0-5]?\d):(?P<s>[0-5]?\d(?:[.,]\d*)?)"
    r"\s*(?:Z|UTC|[+-]\d\d:?\d\d)?"
)
DAY_S = 86400.0

ClockTime = tuple[int, float]
"""The day's number, 0 if it is not known, and the seconds of the day."""


def read_clock(text: str) -> ClockTime | None:
    """Return a time of day, with its day if the text names it; None for any other text."""
    match = _CLOCK.fullmatch(text.strip())
    if match is None:
        return None
    seconds = int(match["h"]) * 3600.0 + int(match["m"]) * 60.0
    seconds += float(match["s"].replace(",", "."))
    try:
        return _number_day(match), seconds
    except ValueError:  # the 31st of February
        return None


def _number_day(match: re.Match[str]) -> int:
    if match["iso"]:
        year, month, day = map(int, re.split("[-/]", match["iso"]))
    elif match["dots"]:
        day, month, year = map(int, match["dots"].split("."))
    else:
        return 0
    return date(year, month, day).toordinal()


def count_seconds(times: Sequence[ClockTime | None]) -> Floats:
    """Return seconds since the first day's midnight, shape (n,); None becomes NaN."""
    first_day = next((time[0] for time in times if time is not None), 0)
    seconds = np.array(
        [np.nan if t is None else (t[0] - first_day) * DAY_S + t[1] for t in times], float
    )
    if first_day == 0:
        with np.errstate(invalid="ignore"):
            turned = np.diff(seconds, prepend=seconds[:1]) < -0.5 * DAY_S
        seconds += DAY_S * np.cumsum(turned)
    return seconds
