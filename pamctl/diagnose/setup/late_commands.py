"""Commands that were logged by reading back, some time later, what the valve held.

Ticks jitter. Where a log reads a held command about a whole number of periods late, it meets the
tick before or the tick after: some commands stand in two rows, and others in none. Which rows
repeat follows from the times of the ticks and from how late the log reads. So the delay shows
without any model, and each command that is left can be put back into its own row.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.fitting.block_fit import fit_numbers
from pamctl.diagnose.fitting.drives import PRESSURE
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.measured.missed_ticks import LONG_PERIODS
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.setup.suspects import READ_BACK, Suspect, find_shown_rows
from pamctl.diagnose.setup.weighed_fit import SuspectFit

FEWEST_ROWS = 200
"""Rows of a moving command that are needed to know it."""
MOST_PERIODS = 12
LEAST_REPEATED = 0.05
"""Share of the rows of a moving command that repeat the row before."""
ALIKE = 0.7
"""Correlation of the rows that repeat with those that a delay predicts. Wrong delays reach 0.5."""
WIDTH, TRIED = 3.0, 25
"""A delay is sought so many jitters about each whole number of periods, at so many places."""


def fit_late_commands(base: Model) -> SuspectFit | None:
    """Return the fit with each command in its own row, where the rows that repeat say so."""
    if PRESSURE not in base.unexplained:
        return None
    drives = (*base.evidence.train[PRESSURE], *base.evidence.holdout[PRESSURE])
    late_s = find_delay_s([(d.times_s, d.valve_v) for d in drives])
    if late_s is None:
        return None
    most_s = 2.0 * MOST_PERIODS * float(np.median(base.evidence.train[PRESSURE][0].step_s))
    blocks = frozenset({PRESSURE})
    suspect = Suspect("skew", "valve_v", "s", -most_s, most_s, (), 1e-3, blocks, READ_BACK)
    fitted = base.fit_of(PRESSURE)
    restored = [suspect.apply(d, late_s) for d in base.evidence.train[PRESSURE]]
    refit = fit_numbers(restored, base.evidence.nominal, fitted.free)
    return SuspectFit(
        base, suspect, late_s, 0.0, {next(b for b in base.fits if PRESSURE in b): refit}
    )


def find_delay_s(records: Sequence[tuple[Array, Array]]) -> float | None:
    """Return how late the commands were read back; None where nothing shows it.

    `records` are times (s) and logged commands (V), both of shape (n,). Below 0: each row shows a
    command that was given later.
    """
    seen = [(t_s, *_find_repeats(valve_v)) for t_s, valve_v in records]
    moving = int(sum(lively.sum() for _, _, lively in seen))
    repeated = int(sum((same & lively).sum() for _, same, lively in seen))
    if moving < FEWEST_ROWS or not LEAST_REPEATED * moving < repeated < moving:
        return None
    steps_s = np.diff(records[0][0])
    period_s = float(np.median(steps_s))
    jitter_s = float(np.std(steps_s[steps_s < LONG_PERIODS * period_s]))
    periods = [n for n in range(-MOST_PERIODS, MOST_PERIODS + 1) if n]
    tried = np.linspace(-WIDTH, WIDTH, TRIED) * jitter_s
    best = max((n * period_s + d for n in periods for d in tried), key=lambda s: _compare(seen, s))
    finer = best + np.linspace(-1.0, 1.0, TRIED) * (tried[1] - tried[0])
    best = max((best, *finer.tolist()), key=lambda s: _compare(seen, s))
    return best if _compare(seen, best) > ALIKE else None


_Seen = tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]


def _find_repeats(valve_v: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which rows repeat the one before, and which are between two that do not."""
    same = np.diff(valve_v, prepend=valve_v[0]) == 0.0
    lively = np.zeros(len(same), np.bool_)
    lively[1:-1] = ~same[:-2] & ~same[2:]
    return same, lively


def _compare(seen: Iterable[_Seen], late_s: float) -> float:
    """Return the correlation of the rows that repeat with those that a delay predicts."""
    asked, told = [], []
    for t_s, same, lively in seen:
        told.append(same[lively])
        rows = find_shown_rows(t_s, late_s)
        asked.append((np.diff(rows, prepend=rows[0] - 1) == 0)[lively])
    predicted, shown = np.concatenate(asked).astype(float), np.concatenate(told).astype(float)
    spread = predicted.std() * shown.std()
    if not spread:
        return 0.0
    return float(np.mean((predicted - predicted.mean()) * (shown - shown.mean())) / spread)
