"""Which rows of a log a piece holds: by time, by rows, or between gaps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pamctl.exit_codes import ExitCode
from pamctl.log.framing import LogError

Floats = NDArray[np.float64]

GAP_PERIODS = 5.0
"""A longer time between two samples is a gap."""
HELD_S = 0.05
"""A command holds over missed ticks of this length: they only make a time step longer."""


class NothingToCut(LogError):
    """The log holds nothing of the piece that was asked for. The message gives the limits."""

    exit_code = ExitCode.USAGE


def find_longest_step_s(step_s: Floats, *, holds_command: bool) -> float:
    """Return the longest time between two samples that is not a gap.

    What a command does in a gap is unknown, and so is what a measured force does in it; but a
    command holds over a few missed ticks.
    """
    shortest_gap_s = GAP_PERIODS * float(np.median(step_s))
    return max(shortest_gap_s, HELD_S) if holds_command else shortest_gap_s


def split_at_gaps(t_s: Floats, *, holds_command: bool) -> tuple[slice, ...]:
    """Return the stretches between gaps, in order; times of shape (n,) without gaps are one."""
    if len(t_s) < 2:
        return (slice(0, len(t_s)),)
    step_s = np.diff(t_s)
    longest_s = find_longest_step_s(step_s, holds_command=holds_command)
    starts = (np.flatnonzero(step_s > longest_s) + 1).tolist()
    return tuple(slice(a, b) for a, b in pairwise([0, *starts, len(t_s)]))


def select_rows(
    name: str,
    t_s: Floats,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    from_row: int | None = None,
    to_row: int | None = None,
) -> slice:
    """Return the rows from `from_s` (included) to `to_s` (excluded), or of these row numbers.

    Rows count from 0. `name` is the log's, for the message. Raise NothingToCut.
    """
    start, stop = from_row or 0, len(t_s) if to_row is None else to_row
    if from_s is not None:
        start = max(start, int(np.searchsorted(t_s, from_s)))
    if to_s is not None:
        stop = min(stop, int(np.searchsorted(t_s, to_s)))
    stop = min(stop, len(t_s))
    if stop - start < 1:
        holds = (
            f"it has rows 0 to {len(t_s) - 1}, from {t_s[0]:.6g} to {t_s[-1]:.6g} s"
            if len(t_s)
            else "it has no rows"
        )
        raise NothingToCut(f"nothing of {name} lies in that piece: {holds}")
    return slice(start, stop)
