"""Columns that are shifted against each other: an answer before its cause, or long after it.

The check uses steps of the command out of a rest. Pressure and position answer them in an order
and within times that no effect of the catalogue can change. A larger chamber answers more slowly:
it may also begin later.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pamctl.diagnose.measured.record import Array, Record

STEP_SHARE = 0.3
"""Share of the command's span that counts as a step."""
LEFT_SHARE = 0.25
"""A command that moves on by this share of a step has left its level."""
QUIET_S, BEFORE_S, AFTER_S = 0.3, 0.15, 0.3
"""The command rests `QUIET_S` before a step. The search for answers begins `BEFORE_S` before the
step and ends `AFTER_S` after it."""
FEWEST_AT_REST = 8
"""With fewer samples before a step, its answer cannot be timed."""
ANSWER_SHARE = 0.05
"""An answer has begun when this share of the whole change is reached."""
LEAST_SHARE = {"pressure_pa": 0.2, "position_m": 0.12}
"""Smaller changes, as shares of the signal's span, are no answer to a step."""
ABOVE_NOISE = 5.0
"""An answer has begun only at this multiple of the scatter at rest."""
EARLY_S = {"pressure_pa": 3e-3, "position_m": 5e-3}
"""Noise and late ticks may make an answer seem to begin this long before its cause."""
EARLY_PERIODS = 1.5
LATE_S = {"pressure_pa": 0.035, "position_m": 0.1}
"""The longest delay with the slowest valve; for the position with the strongest friction too."""
LATE_RISES = 0.5
"""A slow answer may also begin later: by this multiple of the time from its beginning to half."""
CAUSE = {"pressure_pa": "valve_v", "position_m": "pressure_pa"}


class _Response(NamedTuple):
    """When a signal began to answer a step; NaN if it does not answer or did not rest."""

    begins_s: float
    rise_s: float = 0.0
    """From its beginning to half of its change."""


_NONE = _Response(float("nan"))


def check_time_shifts(record: Record) -> Iterator[str]:
    """Yield the reason where a column does not fit the time of its cause."""
    if record.valve_v is None or record.pressure_pa is None:
        return
    if round((QUIET_S - BEFORE_S) / record.period_s) < FEWEST_AT_REST:
        return
    steps = _find_steps(record)
    held_s = [_find_end_s(record, step) for step in steps]
    causes = [_Response(float(record.t_s[step])) for step in steps]
    for channel in ("pressure_pa", "position_m"):
        if channel not in record.channels:
            continue
        answers = [_find_response(record, channel, step) for step in steps]
        pairs = [
            (answer.begins_s - cause.begins_s, _latest_s(channel, cause, answer))
            for cause, answer, end_s in zip(causes, answers, held_s, strict=True)
            if np.isfinite(answer.begins_s - cause.begins_s) and answer.begins_s <= end_s
        ]
        causes = answers
        if not pairs:
            return
        early_s = max(EARLY_S[channel], EARLY_PERIODS * record.period_s)
        late_s = float(np.median([late for late, _ in pairs]))
        if max(late for late, _ in pairs) < -early_s or all(late > most for late, most in pairs):
            order = "before" if late_s < 0.0 else "after"
            yield (
                f"{record.name}: {channel} answers {abs(late_s) * 1e3:.0f} ms {order} "
                f"{CAUSE[channel]}, which no valve, tube or sensor does: the columns are shifted "
                "in time against each other; log them with one clock, or shift them back"
            )


def _latest_s(channel: str, cause: _Response, answer: _Response) -> float:
    """Return the longest time after its cause at which an answer may begin."""
    return max(float(np.hypot(LATE_S[channel], LATE_RISES * answer.rise_s)), cause.rise_s)


def _find_steps(record: Record) -> list[int]:
    """Return the samples at which the command steps out of a rest, away from gaps."""
    command = record["valve_v"]
    least_v = STEP_SHARE * float(np.ptp(command))
    quiet, after = (round(s / record.period_s) for s in (QUIET_S, AFTER_S))
    found = []
    for part in record.segments:
        steps = np.abs(np.diff(command[part]))
        jumps = np.flatnonzero((steps >= least_v) & (steps > 0.0)) + 1 + part.start
        found += [
            int(jump)
            for jump in jumps
            if jump >= part.start + quiet
            and jump + after < part.stop
            and np.ptp(command[jump - quiet : jump]) == 0.0
        ]
    return found


def _find_end_s(record: Record, step: int) -> float:
    """Return when the command leaves the level of a step; what follows may answer that instead."""
    command = record["valve_v"]
    size = abs(command[step] - command[step - 1])
    left = np.flatnonzero(np.abs(command[step:] - command[step]) > LEFT_SHARE * size)
    return float(record.t_s[step + left[0]]) if len(left) else float(record.t_s[-1])


def _find_response(record: Record, channel: str, step: int) -> _Response:
    """Find when a channel begins to answer a step, and how fast."""
    quiet, before, after = (round(s / record.period_s) for s in (QUIET_S, BEFORE_S, AFTER_S))
    values: Array = record[channel]
    rest = values[step - quiet : step - before]
    earlier, later = np.array_split(rest, 2)
    rested, drift = float(later.mean()), float(later.mean() - earlier.mean())
    change = values[step - before : step + after] - rested
    whole = float(change[np.argmax(np.abs(change))])
    begun = ANSWER_SHARE * abs(whole)
    if (
        abs(whole) <= LEAST_SHARE[channel] * float(np.ptp(values))
        or begun < ABOVE_NOISE * float(np.std(rest))
        or abs(drift) > 0.2 * begun
    ):
        return _NONE
    first = int(np.argmax(change / whole > ANSWER_SHARE))
    if not first:
        return _NONE
    half = int(np.argmax(change / whole > 0.5))
    begins_s = float(record.t_s[step - before + first])
    return _Response(begins_s, float(record.t_s[step - before + half]) - begins_s)
