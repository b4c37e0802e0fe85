"""A run that is over: its log as arrays with units, its figures, its pictures; and what it teaches.

From runs to what the model lacks, and from a model to gains.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pamctl.base.errors import Ending, ExitCode
from pamctl.log import Log, read
from pamctl.session.pamctl_error import require_package, translate_errors
from pamctl.settings.config_files import find_config_file
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    read_section_file,
    settings_to_data,
    validate_settings,
)
from pamctl.signals import find_followed_m

if TYPE_CHECKING:
    import pandas

    from pamctl.diagnose import Diagnosis, Record
    from pamctl.plant.model import PlantSettings

    AskedPlant = str | Path | Mapping[str, Any] | PlantSettings


_PICTURE_HEIGHT_PX = 640


@dataclass(frozen=True)
class RunMetrics:
    """The figures of a run in SI; NaN where nothing was tracked.

    Errors are measured displacement minus reference, without homing and approach. The steady
    error is of the last 5 s of each rest.
    """

    max_error_m: float
    rms_error_m: float
    steady_error_m: float
    true_max_error_m: float
    """By the true displacement, which only a simulated rig knows; else NaN."""
    true_rms_error_m: float
    ticks: int
    missed_ticks: int


@dataclass(frozen=True)
class Run:
    """A log in memory: `run["position_m"]` is a column of its ticks, shape (n,).

    The name of a column ends with its unit; all are in SI, and pressure is absolute.
    """

    log: Log

    @classmethod
    def open(cls, path: str | Path) -> Run:
        """Read any log: of a run, of a daemon, or imported. Raises `PamctlError`."""
        with translate_errors():
            return cls(read(path))

    def __getitem__(self, column: str) -> NDArray[Any]:
        """Return a column; raise `PamctlError` with the nearest name where there is none."""
        with translate_errors():
            return self.log[column]

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.log)

    def __repr__(self) -> str:
        """Return file, length and ending in one line."""
        lasts = f"{self.duration_s:g} s" if len(self) else "no ticks"
        return f"<Run {self.path.name}: {lasts}, {self.ending.reason or 'no ending'}>"

    @property
    def path(self) -> Path:
        """The file."""
        return self.log.path

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns."""
        return tuple(self.log.columns)

    @property
    def units(self) -> Mapping[str, str]:
        """The unit of each column."""
        return self.log.units

    @property
    def t_s(self) -> NDArray[np.float64]:
        """Time of each tick (s), shape (n,), since the first tick of the session."""
        return self["t_s"]

    @property
    def duration_s(self) -> float:
        """From the first tick to the last (s)."""
        return float(self.t_s[-1] - self.t_s[0]) if len(self) else 0.0

    @property
    def error_m(self) -> NDArray[np.float64]:
        """Measured displacement minus reference (m), shape (n,); NaN where there is no reference.

        Laws use the column `error_m`, which is of the filtered displacement.
        """
        return np.asarray(find_followed_m(self.log.columns) - self["reference_m"], np.float64)

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that the run was set to: controller, experiment, rig, plant."""
        return self.log.config

    @property
    def events(self) -> list[dict[str, Any]]:
        """Everything that was noted: zeros, marks, trips, the outcome."""
        return self.log.events

    @property
    def marks(self) -> list[tuple[float, str]]:
        """The remarks, each with its time (s) on the axis of `t_s`."""
        marks = [e for e in self.events if e["event"] == "mark"]
        ticks, t_s = self["tick"], self.t_s
        at = [min(int(np.searchsorted(ticks, e["tick"])), len(t_s) - 1) for e in marks]
        return [(float(t_s[i]), str(e["text"])) for i, e in zip(at, marks, strict=True)]

    @property
    def ending(self) -> Ending:
        """How the run ended: exit code and reason."""
        ended = self.log.outcome or {"code": ExitCode.OK, "reason": ""}
        return Ending(ExitCode(ended["code"]), str(ended["reason"]))

    @cached_property
    def metrics(self) -> RunMetrics:
        """The figures of the run."""
        from pamctl.offline.merit import NO_MERIT, compute_log_merits

        merits = {} if self.log.is_imported else compute_log_merits(self.log.columns)
        measured, true = merits.get("measured") or NO_MERIT, merits.get("true") or NO_MERIT
        missed = self.log.columns.get("missed")
        return RunMetrics(
            *measured,
            true.max_m,
            true.rms_m,
            len(self),
            0 if missed is None else int(missed.sum()),
        )

    # --- to other tools -----------------------------------------------------------------------

    def to_pandas(self, columns: Sequence[str] | None = None) -> pandas.DataFrame:
        """Return the ticks as a table with `t_s` as its index; `attrs["units"]` has the units.

        `columns` are the columns to take [default: all]. Raises `PamctlError` without pandas.
        """
        frame_module = require_package("pandas")
        names = [name for name in columns or self.columns if name != "t_s"]
        index = frame_module.Index(self.t_s, name="t_s")
        frame = frame_module.DataFrame({name: self[name] for name in names}, index=index)
        frame.attrs["units"] = {name: self.units[name] for name in names}
        return frame

    def to_record(self) -> Record:
        """Return the signals that `pamctl.diagnose.diagnose` takes; raises `PamctlError`."""
        from pamctl.diagnose import record_of

        with translate_errors():
            return record_of(self.path)

    def report(self, path: str | Path) -> Path:
        """Write the page of `pamctl report`; raise `PamctlError` where it cannot be written."""
        from pamctl.base.new_file import write_files
        from pamctl.report.html_page import write_html
        from pamctl.report.run_page import compose_report

        target = Path(path)
        with translate_errors():
            write_files({target: write_html(compose_report([self.log]))})
        return target

    def _repr_html_(self) -> str:
        """Return figures and pictures of the report, which a notebook shows."""
        from pamctl.report.html_page import write_html
        from pamctl.report.report import Report
        from pamctl.report.reported_run import name_runs
        from pamctl.report.run_motion import write_motion
        from pamctl.report.run_page import write_summary

        runs = name_runs([self.log])
        page = Report(runs[0].name, subtitle=self.ending.reason)
        write_summary(page, runs)
        if len(self):
            write_motion(page, runs)
        # In a frame of its own, the page's style changes nothing of the notebook.
        return (
            f'<iframe srcdoc="{escape(write_html(page))}" style="width:100%; border:0" '
            f'height="{_PICTURE_HEIGHT_PX}"></iframe>'
        )


def find_missing_effects(
    runs: Sequence[Run],
    holdout: Sequence[Run] = (),
    plant: AskedPlant = "paper",
    *,
    progress: Callable[[str], None] = lambda line: None,
) -> Diagnosis:
    """Say what the model `plant` lacks to explain these runs, as `pamctl diagnose` does.

    The model is fitted to `runs`, with each block of samples left out in turn; `holdout` judges
    it too. `progress` gets a line at each step. The result's `plant` is the extended model;
    `pamctl.diagnose.sentence` says the result in words. Raises `PamctlError`.
    """
    from pamctl.diagnose import diagnose

    with translate_errors():
        train, held = ([run.to_record() for run in each] for each in (runs, holdout))
        return diagnose(train, held, _read_plant(plant), progress=progress)


def find_gains(
    law: str = "qsmc",
    plant: AskedPlant = "paper",
    *,
    start: Mapping[str, Any] | None = None,
    generations: int = 10,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> dict[str, Any]:
    """Search gains for a law on a plant by simulation; return the keys of a controller file.

    Each generation tracks one cycle of experiment 1 with some tens of gains, the worst error over
    its bound of Table IV counts. `start` are gains near which the search begins [default: the
    usual ones]; `progress` gets the generation and the best figure so far. `pamctl tune` searches
    longer, on many plants and in many processes. Raises `PamctlError`.
    """
    from pamctl.tune import GainsSearch, GainsTrial, Jury, Member

    with translate_errors():
        jury = Jury((), (Member("plant", _read_plant(plant)),))
        near = None if start is None else dict(start)
        search = GainsSearch(law, jury, seed, near, trial=GainsTrial("short"))
        for generation in range(max(1, generations)):
            best = search.advance()
            if progress is not None:
                progress(generation + 1, best.cost)
        return settings_to_data(SECTIONS["controller"].validate_python(best.gains))


def _read_plant(plant: AskedPlant) -> PlantSettings:
    if isinstance(plant, str | Path):
        path = find_config_file("plant", str(plant), "plant")
        settings: PlantSettings = read_section_file("plant", path)
        return settings
    if isinstance(plant, Mapping):
        raw = RawSettings({**plant}, {(): "plant"})
        checked: PlantSettings = validate_settings(SECTIONS["plant"], raw, title="plant")
        return checked
    return plant
