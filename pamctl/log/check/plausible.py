"""Check the values of the ticks: numbers in order, clocks that agree, units."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.json_text import from_json
from pamctl.log.check.log_problems import LogFindings
from pamctl.log.container import SEQUENCE
from pamctl.log.contents import Contents
from pamctl.log.schema import SCHEMA_VERSION, TICK_TOPIC, unit_of_column
from pamctl.log.ticks import TickBatch
from pamctl.signals import TICK_FIELDS

CLOCK_TOLERANCE_S = 1e-6
"""Two clocks of one log differ by rounding: nanoseconds, and doubles over hours."""
_FIRST_TICKS = 100
"""Ticks whose median step is taken as the period."""
_NEEDED = ("tick", "t_s", "dt_s", "missed")


class TickOrderCheck:
    """Follows the ticks batch by batch, and reports where number or time is not continuous."""

    def __init__(self, findings: LogFindings) -> None:
        self._findings = findings
        self._before: dict[str, NDArray[Any]] = {}
        self._period_s = float("nan")
        self.count = self.missed = self.gaps = 0

    def take(self, batch: TickBatch) -> None:
        """Take the next ticks."""
        if not len(batch.sequence) or not all(name in batch.columns for name in _NEEDED):
            return
        now = {name: batch.columns[name] for name in _NEEDED}
        now["time_ns"] = batch.log_time_ns.astype(np.int64)
        if not self._before:
            # The first tick of a piece of a log may follow a gap.
            self._period_s = float(np.median(now["dt_s"][:_FIRST_TICKS]))
        ticks = {
            name: np.concatenate([self._before.get(name, column[:0]), column])
            for name, column in now.items()
        }
        self._check_numbers(ticks)
        self._times(ticks)
        if (now["tick"] & SEQUENCE != batch.sequence).any():
            at = int(now["tick"][(now["tick"] & SEQUENCE != batch.sequence).argmax()])
            self._findings.error(
                "sequence", f"tick {at} differs from the sequence number of its message"
            )
        self.count += len(batch.sequence)
        self._before = {name: column[-1:] for name, column in now.items()}

    def _check_numbers(self, ticks: dict[str, NDArray[Any]]) -> None:
        tick = ticks["tick"]
        step, missed = np.diff(tick), ticks["missed"][1:]
        self.missed += int(missed.sum())
        self.gaps += int(np.count_nonzero(missed))
        for i in np.flatnonzero(step <= 0):
            self._findings.error("tick-order", f"tick {tick[i + 1]} follows tick {tick[i]}")
        for i in np.flatnonzero((step > 0) & (step - 1 != missed)):
            gone = f"{step[i] - 1} ticks are missing between {tick[i]} and {tick[i + 1]}"
            self._findings.error("gap", f"{gone}, but the loop missed {missed[i]}")

    def _times(self, ticks: dict[str, NDArray[Any]]) -> None:
        tick, t_s, dt_s = ticks["tick"], ticks["t_s"], ticks["dt_s"]
        step = np.diff(t_s)
        for i in np.flatnonzero(~(step > 0)):
            self._clock(f"t_s goes from {t_s[i]} to {t_s[i + 1]}", tick[i + 1])
        # After an uncounted gap, the time since the last tick in the file means nothing.
        whole = (np.diff(tick) - 1 == ticks["missed"][1:]) & (step > 0)
        for i in np.flatnonzero(whole & ~(np.abs(dt_s[1:] - step) <= CLOCK_TOLERANCE_S)):
            self._clock(f"dt_s is {dt_s[i + 1]}, but t_s advanced by {step[i]}", tick[i + 1])
        wall = np.diff(ticks["time_ns"]) * 1e-9
        for i in np.flatnonzero(~(np.abs(wall - step) <= CLOCK_TOLERANCE_S)):
            self._clock(f"log_time advanced by {wall[i]} s, but t_s by {step[i]}", tick[i + 1])
        periods = dt_s[1:] / self._period_s - (1 + ticks["missed"][1:])
        for i in np.flatnonzero(whole & ~(np.abs(periods) <= 1.0)):
            detail = f"dt_s is {dt_s[i + 1]}, with {ticks['missed'][i + 1]} missed ticks"
            self._findings.warning("period", f"at tick {tick[i + 1]}, {detail}")

    def _clock(self, what: str, tick: int) -> None:
        self._findings.error("clock", f"at tick {tick}, {what}")

    def end(self) -> None:
        """Report the number of missed ticks."""
        if self.missed:
            counted = f"{self.missed} ticks in {self.gaps} gaps were missed; the log counts them"
            self._findings.note("missed", counted)


def check_columns(contents: Contents, findings: LogFindings) -> None:
    """Check that the ticks have the expected columns, each with its unit."""
    if contents.ticks is None:
        return
    channel = next(c for c in contents.channels.values() if c.topic == TICK_TOPIC)
    try:
        version = int(channel.metadata.get("schema_version", 0))
        stated = dict(from_json(channel.metadata.get("units", "{}")))
    except (ValueError, TypeError) as error:
        findings.error("units", f"the metadata of {TICK_TOPIC} makes no sense: {error}")
        return
    for name, column in contents.ticks.none.items():
        unit = unit_of_column(name)
        if column.dtype.kind == "f" and unit == "1":
            findings.error("units", f"the name of {name} states no unit")
        elif stated.get(name) != unit:
            findings.error(
                "units", f"{name} is stated in {stated.get(name)}, but its name says {unit}"
            )
    if version > SCHEMA_VERSION:
        findings.warning("version", f"schema {version} is newer than this pamctl's")
    known = [field.name for field in TICK_FIELDS] if version == SCHEMA_VERSION else _NEEDED
    for name in _NEEDED if contents.is_imported else known:
        if name not in contents.ticks.none:
            findings.error("columns", f"there is no column {name}")
