"""Columns that are shifted in time: an answer before its cause, or too long after it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pamctl.base.errors import Problem
from pamctl.diagnose.record import Array, Record

STEP_SHARE, LEFT_SHARE = 0.3, 0.25
"""Share of the command's span that counts as a step; share of a step by which it is left."""
QUIET_S, BEFORE_S, AFTER_S = 0.3, 0.15, 0.3
"""The command rests `QUIET_S` before a step. The search for answers begins `BEFORE_S` before the
step and ends `AFTER_S` after it."""
FEWEST_AT_REST = 8
"""With fewer samples before a step, its answer cannot be timed."""
ANSWER_SHARE, ABOVE_NOISE = 0.05, 5.0
"""An answer has begun when this share of the whole change is reached, and this multiple of the
scatter at rest."""
LEAST_SHARE = {"pressure_pa": 0.2, "position_m": 0.12}
"""Smaller changes, as shares of the signal's span, are no answer to a step."""
EARLY_S, EARLY_PERIODS = {"pressure_pa": 3e-3, "position_m": 5e-3}, 1.5
"""Noise and late ticks may make an answer seem to begin this long before its cause."""
LATE_S = {"pressure_pa": 0.035, "position_m": 0.1}
"""The longest delay with the slowest valve; for the position with the strongest friction too."""
LATE_RISES = 0.5
"""A slow answer may also begin later: by this multiple of the time from its beginning to half."""
END_SHARE = 0.02
"""Of its way, within which a position is at its end."""
CAUSE = {"pressure_pa": "valve_v", "position_m": "pressure_pa"}


def find_usual_ends(values: Array) -> tuple[float, float]:
    """Return the range of a signal without its rarest values."""
    return float(np.quantile(values, 0.001)), float(np.quantile(values, 0.999))


def check_time_shifts(record: Record, *, rests_on_stop: bool = False) -> Iterator[Problem]:
    """Yield what is wrong where a column is shifted: an answer before its cause, or long after it.

    Pressure and position answer steps of the command out of a rest in an order and within times
    that no effect of the catalogue can change. A larger chamber answers more slowly, and may also
    begin later. A position that `rests_on_stop` may wait for the pressure that carries its load.
    """
    quiet = round((QUIET_S - BEFORE_S) / record.period_s)
    if record.valve_v is None or record.pressure_pa is None or quiet < FEWEST_AT_REST:
        return
    found: dict[str, list[tuple[float, float]]] = {c: [] for c in CAUSE if c in record.channels}
    for step, end_s in _find_steps(record):
        cause_s, cause_rise_s = float(record.t_s[step]), 0.0
        for channel, pairs in found.items():
            answer = _find_response(record, channel, step)
            if answer is None:
                break
            begins_s, rise_s = answer
            most_s = max(float(np.hypot(LATE_S[channel], LATE_RISES * rise_s)), cause_rise_s)
            if channel == "position_m" and rests_on_stop and _is_at_end(record, step):
                most_s = np.inf
            if begins_s <= end_s:
                pairs.append((begins_s - cause_s, most_s))
            cause_s, cause_rise_s = begins_s, rise_s
    for channel, pairs in found.items():
        if not pairs:
            return
        early_s = max(EARLY_S[channel], EARLY_PERIODS * record.period_s)
        late_s = float(np.median([late for late, _ in pairs]))
        if max(late for late, _ in pairs) < -early_s or all(late > most for late, most in pairs):
            order = "before" if late_s < 0.0 else "after"
            yield Problem(
                record.name,
                "shifted",
                f"{channel} answers {abs(late_s) * 1e3:.0f} ms {order} "
                f"{CAUSE[channel]}, which no valve, tube or sensor does: the columns are shifted "
                "in time against each other",
                fix="log them with one clock, or shift them back"
                + ("; where a stop held it, give the plant file stroke_m" * (late_s > 0.0)),
            )


def _is_at_end(record: Record, row: int) -> bool:
    """Tell whether the position is at an end of its way."""
    low, high = find_usual_ends(record["position_m"])
    return bool(min(record["position_m"][row] - low, high - record["position_m"][row])
                < END_SHARE * (high - low))  # fmt: skip


def _find_steps(record: Record) -> Iterator[tuple[int, float]]:
    """Yield each step of the command out of a rest, away from gaps, and when its level is left."""
    command = record["valve_v"]
    sizes = np.abs(np.diff(command, prepend=command[0]))
    quiet, after = (round(s / record.period_s) for s in (QUIET_S, AFTER_S))
    steps = np.flatnonzero((sizes >= STEP_SHARE * float(np.ptp(command))) & (sizes > 0.0))
    for part in record.segments:
        for step in steps[(steps >= part.start + quiet) & (steps < part.stop - after)].tolist():
            if np.ptp(command[step - quiet : step]) > 0.0:
                continue
            away = np.abs(command[step:] - command[step]) > LEFT_SHARE * sizes[step]
            end = step + int(np.argmax(away)) if away.any() else -1
            yield step, float(record.t_s[end])


def _find_response(record: Record, channel: str, step: int) -> tuple[float, float] | None:
    """Return when a channel begins to answer a step, and its time from there to half, in s.

    None where it does not answer, or did not rest.
    """
    quiet, before, after = (round(s / record.period_s) for s in (QUIET_S, BEFORE_S, AFTER_S))
    values: Array = record[channel]
    rest = values[step - quiet : step - before]
    earlier, later = (float(half.mean()) for half in np.array_split(rest, 2))
    change = values[step - before : step + after] - later
    whole = float(change[np.argmax(np.abs(change))])
    begun = ANSWER_SHARE * abs(whole)
    if (
        abs(whole) <= LEAST_SHARE[channel] * float(np.ptp(values))
        or begun < ABOVE_NOISE * float(np.std(rest))
        or abs(later - earlier) > 0.2 * begun
    ):
        return None
    first = int(np.argmax(change / whole > ANSWER_SHARE))
    if not first:
        return None
    half = int(np.argmax(change / whole > 0.5))
    begins_s, half_s = (float(record.t_s[step - before + k]) for k in (first, half))
    return begins_s, half_s - begins_s
