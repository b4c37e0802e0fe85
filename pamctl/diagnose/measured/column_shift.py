"""Columns that are shifted against each other: an answer before its cause, or long after it.

The check uses steps of the command out of a rest. Pressure and position answer them in an order
and within times that no effect of the catalogue can change.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pamctl.diagnose.measured.record import Array, Record

STEP_V = 3.0
QUIET_S, BEFORE_S, AFTER_S = 0.3, 0.15, 0.3
"""The command rests `QUIET_S` before a step. The search for answers begins `BEFORE_S` before the
step and ends `AFTER_S` after it."""
ANSWER_SHARE = 0.05
"""An answer has begun when this share of the whole change is reached."""
LEAST_CHANGE = {"pressure_pa": 80e3, "position_m": 3e-3}
"""Smaller changes are no answer to a step."""
EARLY_S = {"pressure_pa": 3e-3, "position_m": 5e-3}
"""Noise and late ticks may make an answer seem to begin this long before its cause."""
LATE_S = {"pressure_pa": 0.035, "position_m": 0.1}
"""The longest delay with the slowest valve; for the position with the strongest friction too."""
CAUSE = {"pressure_pa": "valve_v", "position_m": "pressure_pa"}


def check_time_shifts(record: Record) -> Iterator[str]:
    """Yield the reason where a column does not fit the time of its cause."""
    if record.valve_v is None or record.pressure_pa is None:
        return
    steps = _find_steps(record)
    causes = [float(record.t_s[step]) for step in steps]
    for channel in ("pressure_pa", "position_m"):
        if channel not in record.channels:
            continue
        answers = [_find_response_s(record, channel, step) for step in steps]
        late = [a - c for c, a in zip(causes, answers, strict=True) if np.isfinite(a - c)]
        causes = answers
        if not late:
            return
        late_s = float(np.median(late))
        if max(late) < -EARLY_S[channel] or min(late) > LATE_S[channel]:
            order = "before" if late_s < 0.0 else "after"
            yield (
                f"{record.name}: {channel} answers {abs(late_s) * 1e3:.0f} ms {order} "
                f"{CAUSE[channel]}, which no valve, tube or sensor does: the columns are shifted "
                "in time against each other; log them with one clock, or shift them back"
            )


def _find_steps(record: Record) -> list[int]:
    """Return the samples at which the command steps out of a rest."""
    command = record["valve_v"]
    jumps = np.flatnonzero(np.abs(np.diff(command)) >= STEP_V) + 1
    quiet, after = (round(s / record.period_s) for s in (QUIET_S, AFTER_S))
    return [
        int(jump)
        for jump in jumps
        if jump >= quiet
        and jump + after < len(record)
        and np.ptp(command[jump - quiet : jump]) == 0.0
    ]


def _find_response_s(record: Record, channel: str, step: int) -> float:
    """Return when a channel begins to answer a step; NaN if it does not answer or did not rest."""
    quiet, before, after = (round(s / record.period_s) for s in (QUIET_S, BEFORE_S, AFTER_S))
    values: Array = record[channel]
    earlier, later = np.array_split(values[step - quiet : step - before], 2)
    rested, drift = float(later.mean()), float(later.mean() - earlier.mean())
    change = values[step - before : step + after] - rested
    whole = float(change[np.argmax(np.abs(change))])
    if abs(whole) < LEAST_CHANGE[channel] or abs(drift) > 0.2 * ANSWER_SHARE * abs(whole):
        return float("nan")
    first = int(np.argmax(change / whole > ANSWER_SHARE))
    if not first:
        return float("nan")
    return float(record.t_s[step - before + first])
