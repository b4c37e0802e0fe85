"""Dates as people say them: `2026-11-20`, `monday`, `yesterday`, `2 days ago`, `14:30`."""

from __future__ import annotations

import re
from datetime import datetime, time, timedelta
from typing import NamedTuple

from pamctl.exit_codes import ExitCode

_DAYS = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
_UNITS = {
    "s": 1.0, "second": 1.0, "min": 60.0, "minute": 60.0, "h": 3600.0, "hour": 3600.0,
    "d": 86400.0, "day": 86400.0, "w": 604800.0, "week": 604800.0,
}  # fmt: skip
_AGO = re.compile(r"(\d+(?:\.\d+)?|an?)\s*([a-z]+?)s?(?:\s+ago)?")
_EXAMPLES = "write 2026-11-20, '2026-11-20 14:30', 14:30, today, monday or '2 days ago'"


class DateError(Exception):
    """A date makes no sense. The message says what does."""

    exit_code = ExitCode.USAGE


class DateSpan(NamedTuple):
    """What a date means, in seconds since the epoch: a day, or an instant of no length."""

    first_s: float
    end_s: float


def parse_date(text: str, now: datetime | None = None) -> DateSpan:
    """Return what a date means in the time zone of this PC; raise DateError.

    A day of the week is the latest one, and today if today is one. `now` is naive local time.
    """
    now = now or datetime.now()
    said = " ".join(text.lower().split())
    if (day := _find_day(said, now)) is not None:
        # Not 24 hours on: a day may have 23 or 25.
        return DateSpan(day.timestamp(), (day + timedelta(days=1)).timestamp())
    try:
        instant = _find_instant(said, now)
        return DateSpan(instant.timestamp(), instant.timestamp())
    except (ValueError, OverflowError, OSError):
        raise DateError(f"{text!r} is no date; {_EXAMPLES}") from None


def _find_day(said: str, now: datetime) -> datetime | None:
    today = datetime.combine(now.date(), time())
    if said in ("today", "yesterday"):
        return today - timedelta(days=said == "yesterday")
    for number, name in enumerate(_DAYS):
        if said in (name, name[:3]):
            return today - timedelta(days=(today.weekday() - number) % 7)
    try:
        return datetime.strptime(said, "%Y-%m-%d")
    except ValueError:
        return None


def _find_instant(said: str, now: datetime) -> datetime:
    if said == "now":
        return now
    if clock := re.fullmatch(r"(\d{1,2}):(\d\d)(?::(\d\d))?", said):
        hour, minute, second = (int(part or 0) for part in clock.groups())
        return datetime.combine(now.date(), time(hour, minute, second))
    if ago := _AGO.fullmatch(said):
        count = 1.0 if ago[1] in ("a", "an") else float(ago[1])
        if ago[2] not in _UNITS:
            raise ValueError(said)
        return now - timedelta(seconds=count * _UNITS[ago[2]])
    return datetime.fromisoformat(said.upper())
