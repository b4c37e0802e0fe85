"""Figures of merit of a tracking run, and the paper's Table IV for comparison.

The error is measured displacement minus reference, without the approach. Steady state is the last
5 s of each rest. A simulated run also has the true displacement.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.log.reader import Log
from pamctl.log.row_problems import find_runs
from pamctl.signals import Phase, find_followed_m

STEADY_S = 5.0

Floats = NDArray[np.float64]


class Merit(NamedTuple):
    """Errors in m; `steady_m` is NaN if no rest was long enough."""

    max_m: float
    rms_m: float
    steady_m: float

    def as_dict(self) -> dict[str, float | None]:
        """Return the errors by name for a document, where one that is not known is None."""
        return {name: None if value != value else value for name, value in self._asdict().items()}


NO_MERIT = Merit(np.nan, np.nan, np.nan)


class PaperRow(NamedTuple):
    """A column of Table IV, in m."""

    experiment: str
    law: str
    merit: Merit


TABLE_IV = (
    PaperRow("tracking-1", "smc", Merit(292e-6, 43.2e-6, 15e-6)),
    PaperRow("tracking-1", "qsmc", Merit(272e-6, 35.6e-6, 15e-6)),
    PaperRow("tracking-2", "smc", Merit(284e-6, 43.2e-6, np.nan)),
    PaperRow("tracking-2", "qsmc", Merit(291e-6, 55.3e-6, np.nan)),
)


def find_paper_rows(experiment: str | None) -> list[PaperRow]:
    """Return the rows of Table IV for an experiment; none where it is not the paper's."""
    return [row for row in TABLE_IV if row.experiment == experiment]


def find_strictest(experiment: str) -> Merit:
    """Return the smallest of each error that the paper states for an experiment, of any law."""
    return Merit(*map(min, *(row.merit for row in find_paper_rows(experiment))))


def compute_merit(t_s: Floats, phase: NDArray[np.int64], error_m: Floats) -> Merit | None:
    """Return the figures of an error signal, arrays of shape (n,); None if nothing was tracked."""
    counted = (phase == Phase.TRACK) | (phase == Phase.REST)
    errors = np.abs(error_m[counted])
    if not len(errors):
        return None
    steady = [np.abs(error_m[part]).max() for part in _find_steady_parts(t_s, phase)]
    return Merit(
        float(errors.max()),
        float(np.sqrt(np.mean(errors**2))),
        float(max(steady, default=np.nan)),
    )


def _find_steady_parts(t_s: Floats, phase: NDArray[np.int64]) -> list[slice]:
    """Return the last 5 s of each rest that lasts at least 5 s."""
    parts = []
    for begin, end in find_runs(phase == Phase.REST).tolist():
        # A tick lasts until the next one; half a tick allows for rounding.
        tick_s = (t_s[end - 1] - t_s[begin]) / max(1, end - 1 - begin)
        first = int(np.searchsorted(t_s[:end], t_s[end - 1] + 0.5 * tick_s - STEADY_S))
        if first > begin or t_s[end - 1] - t_s[begin] + 1.5 * tick_s >= STEADY_S:
            parts.append(slice(max(first, begin), end))
    return parts


def compute_log_merits(columns: Mapping[str, Any]) -> dict[str, Merit | None]:
    """Return the figures of a log's columns: `measured`, and `true` if the rig was simulated.

    Empty where the log has no reference, or no displacement.
    """
    if not {"t_s", "phase", "reference_m", "position_m"} <= columns.keys():
        return {}
    positions = {"measured": find_followed_m(columns)}
    true_m = columns.get("true_position_m")
    if true_m is not None and np.isfinite(true_m).any():
        positions["true"] = true_m
    t_s, phase, reference_m = columns["t_s"], columns["phase"], columns["reference_m"]
    return {
        name: compute_merit(t_s, phase, position_m - reference_m)
        for name, position_m in positions.items()
    }


def summarise_timing(log: Log) -> dict[str, dict[str, float]]:
    """Return, in s, the spread of wake-up lateness, tick duration, rig reads and rig writes."""
    parts = {
        "wake_up": log["late_s"],
        "tick": log["compute_s"],
        "period_work": log["read_s"] + log["compute_s"] + log["write_s"],
        "read": log["read_s"],
        "write": log["write_s"],
    }
    return {name: _find_spread(part[np.isfinite(part)]) for name, part in parts.items()}


def _find_spread(durations_s: Floats) -> dict[str, float]:
    if not len(durations_s):
        return dict.fromkeys(("p50_s", "p99_s", "max_s"), np.nan)
    p50, p99 = np.percentile(durations_s, (50, 99)).tolist()
    return {"p50_s": p50, "p99_s": p99, "max_s": float(durations_s.max())}
