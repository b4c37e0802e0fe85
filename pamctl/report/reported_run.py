"""A log for a report, on a suitable time axis; and the figures of a run, tracking and timing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os.path import commonpath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.base.texts import count_of
from pamctl.control.law_registry import LawWords, read_law_words
from pamctl.log import Log
from pamctl.log.run_meta import Moment, list_moments
from pamctl.offline.merit import (
    NO_MERIT,
    Merit,
    compute_log_merits,
    find_paper_rows,
    summarise_timing,
)
from pamctl.report.report import Report, ReportTable, Text, spell_um
from pamctl.settings.resolve import resolve, settings_to_data
from pamctl.signals import Phase

Floats = NDArray[np.float64]

REPORT_FIELDS = (
    *("tick", "t_s", "phase", "missed", "verdicts", "saturated"),
    *("position_m", "corrected_position_m", "true_position_m"),
    *("reference_m", "reference_valve_v", "error_rate_m_per_s", "surface_m_per_s2"),
    *("pressure_pa", "force_n", "command_v", "valve_v", "equivalent_v", "robust_v"),
    *("late_s", "read_s", "compute_s", "write_s"),
)
"""The columns of a log that a report shows, of those that it has."""

MICRO = 1e6


@dataclass(frozen=True)
class ReportedRun:
    """One log, under a name that tells it from the others."""

    log: Log
    name: str
    colour: int = 0
    """Its colour beside other runs, in every plot of a page."""

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.log)

    def column(self, name: str, scale: float = 1.0) -> Floats | None:
        """Return a column times `scale`, shape (n,); None if it is missing or never finite."""
        values = self.log.columns.get(name)
        if values is None or not np.isfinite(values).any():
            return None
        return np.asarray(values, np.float64) * scale

    @cached_property
    def phase(self) -> NDArray[np.int64]:
        """The phase of each tick; -1 where it is unknown."""
        known = self.log.columns.get("phase")
        return np.full(len(self), -1) if known is None else np.asarray(known, np.int64)

    @cached_property
    def shown(self) -> NDArray[np.bool_]:
        """The ticks that plots show: all but homing and the final stop, or all if none remain."""
        course: NDArray[np.bool_] = np.isin(self.phase, (Phase.HOMING, Phase.STOPPING), invert=True)
        return course if bool(course.any()) else np.ones(len(self), np.bool_)

    @property
    def has_homing(self) -> bool:
        """Whether plots leave out a homing; then time begins at its end."""
        return len(self) > 0 and not bool(self.shown[0])

    @cached_property
    def t_s(self) -> Floats:
        """Seconds since the first tick that is shown."""
        return np.asarray(self.log.columns.get("t_s", np.zeros(0)), np.float64) - self.begin_s

    @cached_property
    def begin_s(self) -> float:
        """The time of the first tick that is shown, on the log's own axis."""
        t_s = self.log.columns.get("t_s", np.zeros(0))
        return float(t_s[int(self.shown.argmax())]) if len(t_s) else 0.0

    @cached_property
    def tracked(self) -> NDArray[np.bool_]:
        """The ticks that count for the figures of merit."""
        counted: NDArray[np.bool_] = np.isin(self.phase, (Phase.TRACK, Phase.REST))
        return counted

    @property
    def law_at_work(self) -> NDArray[np.bool_]:
        """The ticks that show the law at work: tracking, or else the approach."""
        return self.tracked if self.tracked.any() else self.shown

    @cached_property
    def error_m(self) -> Floats | None:
        """Measured displacement minus reference; None without a reference."""
        position, reference = self.followed_m, self.column("reference_m")
        return None if position is None or reference is None else position - reference

    @property
    def followed_m(self) -> Floats | None:
        """The measured displacement whose error counts; see `pamctl.signals.find_followed_m`."""
        corrected = self.column("corrected_position_m")
        return self.column("position_m") if corrected is None else corrected

    @property
    def meta(self) -> dict[str, str]:
        """The log's metadata on its run: law, controller, experiment, plant, rig, backend."""
        return dict(self.log.metadata.get("run", {}))

    @cached_property
    def law(self) -> LawWords:
        """What its law and the law's terms are called: as the log says, or the installed law."""
        return read_law_words(self.log.metadata.get("law", {}), self.meta.get("law", ""))

    @property
    def fast(self) -> bool:
        """Whether the run was simulated without a clock."""
        return bool(self.log.config.get("fast"))

    def time_of(self, event: Mapping[str, Any]) -> float | None:
        """Return the time of an event on the axis of `t_s`; None if its tick is unknown."""
        ticks = self.log.columns.get("tick")
        if ticks is None or not len(ticks) or not isinstance(event.get("tick"), int):
            return None
        return float(self.t_s[min(int(np.searchsorted(ticks, event["tick"])), len(ticks) - 1)])

    @cached_property
    def moments(self) -> list[Moment]:
        """Marks, changes of gains and the trip, on the axis of `t_s`."""
        return [Moment(at_s - self.begin_s, text) for at_s, text in list_moments(self.log)]

    @property
    def paper_experiment(self) -> str | None:
        """The paper's experiment with exactly these settings, of its muscle; else None."""
        return find_paper_experiment(self.log.config)


def name_runs(logs: Sequence[Log]) -> list[ReportedRun]:
    """Return the logs under names that are as short as possible."""
    paths = [log.path for log in logs]
    if len({path.stem for path in paths}) == len(paths):
        return [ReportedRun(log, log.path.stem, colour) for colour, log in enumerate(logs)]
    whole = [path.absolute() for path in paths]
    above = Path(commonpath([path.parent for path in whole]))
    names = [str(path.relative_to(above).with_suffix("")) for path in whole]
    numbered = len(set(names)) < len(names)
    return [
        ReportedRun(log, f"{name} ({number})" if numbered else name, number - 1)
        for number, (log, name) in enumerate(zip(logs, names, strict=True), 1)
    ]


# --- the figures of a run ---------------------------------------------------------------------

PAPER_EXPERIMENTS = ("tracking-1", "tracking-2")
FIGURE_FIELDS = (
    *("t_s", "phase", "missed", "reference_m"),
    *("position_m", "corrected_position_m", "true_position_m"),
    *("late_s", "read_s", "compute_s", "write_s"),
)
"""The columns of a log that `summarise_run` needs."""


def find_paper_experiment(config: Mapping[str, Any]) -> str | None:
    """Return the paper's experiment of which a run's settings are: Table IV is about those.

    None for another experiment, and for another muscle than the paper's; what its model lacks, the
    `effects`, do not count.
    """
    paper, plant = settings_to_data(resolve().plant), config.get("plant", {})
    if any(plant.get(key, paper.get(key)) != paper.get(key) for key in ("actuator", "parameters")):
        return None
    return next(
        (
            name
            for name in PAPER_EXPERIMENTS
            if settings_to_data(resolve(experiment=name).experiment) == config.get("experiment")
        ),
        None,
    )


def summarise_run(log: Log) -> dict[str, Any]:
    """Return the figures of a run as one JSON document: SI, None for what is not known."""
    experiment = find_paper_experiment(log.config)
    setup, refused = log.metadata.get("timing_setup", {}), "not done: "
    return {
        "ticks": len(log),
        "missed_ticks": int(log["missed"].sum()),
        "readonly": bool(log.config.get("readonly")),
        "tracking": summarise_tracking(log),
        "paper": [{"law": r.law, **r.merit.as_dict()} for r in find_paper_rows(experiment)],
        "timing": None if log.config.get("fast") else summarise_timing(log),
        "not_real_time": {
            step: said.removeprefix(refused)
            for step, said in setup.items()
            if said.startswith(refused)
        },
    }


_Tracking = Mapping[str, Mapping[str, float | None]]


def summarise_tracking(log: Log) -> _Tracking:
    """Return the figures of merit of a log by `measured` and, if it was simulated, `true`."""
    merits = compute_log_merits(log.columns)
    return {name: (merit or NO_MERIT).as_dict() for name, merit in merits.items()}


OTHER_ZERO = (
    "The true error is larger than the measured one: homing takes the encoder's zero where the "
    "vented rig came to rest, and friction or creep lets it rest elsewhere than the model's zero."
)
_LARGE_ZERO_M = 50e-6
"""The counts of an encoder and the lag of a filter make less."""


def has_other_zero(tracking: _Tracking) -> bool:
    """Tell whether the true error of a simulated run has an offset that the measured one lacks."""
    measured, true = (tracking.get(name, {}).get("rms_m") for name in ("measured", "true"))
    if measured is None or true is None:
        return False
    return true**2 > measured**2 + _LARGE_ZERO_M**2


MERIT_HEADER = ("tracking error, µm", "max", "RMS", "steady")


def make_merit_row(name: str, errors_m: Iterable[float | None]) -> list[str]:
    """Return a row of a table with `MERIT_HEADER`, of the largest, RMS and steady error in m."""
    return [name, *map(spell_um, errors_m)]


def report_run(figures: Mapping[str, Any], law: str) -> Report:
    """Return what is said of a run at its end, from the document of `summarise_run`."""
    ran = f"{count_of(figures['ticks'], 'tick')}, {figures['missed_ticks']} missed"
    if figures["timing"] is None:
        ran += "; simulated without a clock"
    report = Report(f"Run of {law}", ran, document=figures)
    tracked = [
        make_merit_row(f"{law}, {name} displacement", merit.values())
        for name, merit in figures["tracking"].items()
        if merit["max_m"] is not None
    ]
    if figures["readonly"]:
        report.add(Text("Read only: the output stayed at the safe voltage; nothing was tracked."))
    elif not tracked:
        report.add(Text("Nothing was tracked in this run."))
    else:
        papers = [
            make_merit_row(f"paper, {row['law']} on its rig", [row[key] for key in Merit._fields])
            for row in figures["paper"]
        ]
        report.add(ReportTable(MERIT_HEADER, [*tracked, *papers]))
        report.add(*[Text(OTHER_ZERO)] * has_other_zero(figures["tracking"]))
    if figures["timing"] is not None:
        report.add(tabulate_timing(figures["timing"]))
    refused = figures["not_real_time"].items()
    return report.add(*(Text(f"not real time: {step} refused: {why}") for step, why in refused))


def tabulate_timing(timing: Mapping[str, Mapping[str, float]]) -> ReportTable:
    """Return the table of a run's durations, as `summarise_run` has them."""
    named = {
        "wake_up": "wake-up behind deadline",
        "tick": "tick, sample to command",
        "period_work": "read, tick and write",
    }
    parts = ("p50_s", "p99_s", "max_s")
    rows = [[name, *(spell_um(timing[key][part]) for part in parts)] for key, name in named.items()]
    return ReportTable(("timing, µs", "p50", "p99", "max"), rows)
