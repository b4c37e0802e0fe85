"""The commands of another law, or of other gains, on the samples of a log: open loop.

The muscle did not follow these commands. They show how the law answers to the logged error, but
not how well it would have tracked: for that, run it.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.base.errors import ConfigError, Problem
from pamctl.base.new_file import write_files
from pamctl.log import Log
from pamctl.offline.replay_source import (
    REPLAYED_FIELDS,
    NotReplayable,
    read_replay_source,
)
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import (
    RUN,
    RawSettings,
    RunSettings,
    settings_to_data,
    validate_settings,
)
from pamctl.signals import Phase

Floats = NDArray[np.float64]

_COMMAND = [field.name for field in REPLAYED_FIELDS].index("command_v")
_LOGGED = ("t_s", "phase", "command_v", "saturated")
_SATURATED = [field.name for field in REPLAYED_FIELDS].index("saturated")


class PhaseFigures(NamedTuple):
    """Figures of two commands in one phase of a run, in V."""

    phase: str
    ticks: int
    logged_rms_v: float
    other_rms_v: float
    difference_rms_v: float
    difference_max_v: float
    logged_saturated: float
    """Share of the ticks in which the law reached its own limit."""
    other_saturated: float


@dataclass(frozen=True)
class WhatIf:
    """The commands of a log and of another law, in the ticks in which a law ran."""

    ticks: NDArray[np.int64]
    """Place of each tick in the log, from 0; shape (n,), as all arrays here."""
    t_s: Floats
    phase: NDArray[np.int64]
    logged_v: Floats
    other_v: Floats
    phases: tuple[PhaseFigures, ...]

    def write_csv(self, path: Path) -> None:
        """Write both commands into a new file, one row a tick; raise NewFileError."""
        text = StringIO()
        table = csv.writer(text)
        table.writerow(("tick", "t_s", "phase", "command_v", "what_if_command_v"))
        columns = (self.ticks, self.t_s, self.phase, self.logged_v, self.other_v)
        table.writerows(zip(*(column.tolist() for column in columns), strict=True))
        write_files({path: text.getvalue()})


def replace_law(
    settings: RunSettings, controller: str | None, overrides: Sequence[str]
) -> RunSettings:
    """Return a run's settings with another gains file and `controller.*` overrides.

    Raises ConfigError.
    """
    raw = RawSettings(settings_to_data(settings), {(): "the log's configuration"})
    if controller is not None:
        raw.add_section("controller", controller)
    for override in overrides:
        if not override.strip().startswith("controller."):
            message = "a what-if changes only the law; only controller.* can be set"
            raise ConfigError([Problem(f"--set {override}", "", message)])
        raw.override(override)
    return validate_settings(RUN, raw)


def run_what_if(log: Log, settings: RunSettings, *, from_s: float | None = None) -> WhatIf:
    """Run the law of `settings` on the samples of a log; raise NotReplayable.

    It begins where `replay` would begin. Changes of gains during the run are ignored.
    """
    recording = read_replay_source(log)
    begin = 0 if from_s is None else recording.find_tick_before(from_s) + 1
    setup = build_tick_setup(settings)
    parts: list[tuple[NDArray[Any], ...]] = []
    for start, end, after, rows in recording.run_stretches(begin, setup):
        if after is None:
            continue
        others = rows[[_COMMAND, _SATURATED]]
        by_law = np.isfinite(others[0]) & np.isnan(log["reference_valve_v"][start:end])
        logged = (log[name][start:end][by_law] for name in _LOGGED)
        parts.append((start + np.flatnonzero(by_law), *logged, *others[:, by_law]))
    if not any(len(part[0]) for part in parts):
        raise NotReplayable(
            f"{log.path} has no tick in which a law ran: there is nothing to compare"
        )
    ticks, t_s, phase, logged_v, logged_saturated, other_v, saturated = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    phases = []
    for number in np.unique(phase).tolist():
        there = phase == number
        apart_v = other_v[there] - logged_v[there]
        figures = PhaseFigures(
            phase=Phase(number).name.lower(),
            ticks=int(there.sum()),
            logged_rms_v=_rms(logged_v[there]),
            other_rms_v=_rms(other_v[there]),
            difference_rms_v=_rms(apart_v),
            difference_max_v=float(np.abs(apart_v).max()),
            logged_saturated=float(logged_saturated[there].mean()),
            other_saturated=float(saturated[there].mean()),
        )
        phases.append(figures)
    return WhatIf(ticks, t_s, phase, logged_v, other_v, tuple(phases))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
