"""Make the runs of a sweep by `pamctl run`'s own means: simulated, or on the rig."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pamctl.exit_codes import Ending, ExitCode
from pamctl.log.annotation import SWEEP, Annotation
from pamctl.log.run_meta import bare_name, make_dated_path
from pamctl.processes.interrupts import restore_signals
from pamctl.processes.run_once import run_once
from pamctl.report.progress_line import ProgressLine
from pamctl.settings.resolve import RunSettings, settings_to_data
from pamctl.sweep.run_sweep import SweepPlan
from pamctl.sweep.sweep_plan import SweepRequest, SweepRun, list_runs


class OwnRunner:
    """Makes each run with its own processes. The muscle is homed again before each."""

    def __init__(
        self,
        points: Sequence[RunSettings],
        names: Mapping[str, str],
        folder: Path,
        progress: Callable[[], ProgressLine],
    ) -> None:
        """`points` are the settings of each point, by its number."""
        self._points = points
        self._names = dict(names)
        self._folder = folder
        self._progress = progress

    def plan_sweep(
        self,
        base: RunSettings,
        request: SweepRequest,
        repeats: int,
        name: str,
        said: Annotation,
    ) -> SweepPlan:
        """Return what is to be run; `base` are the settings without the swept ones."""
        points = [request.read_point(settings_to_data(settings)) for settings in self._points]
        mark = request.mark_base({**settings_to_data(base), "names": self._names})
        return SweepPlan(name, mark, list_runs(points, repeats), self._folder, said)

    @property
    def goes_on(self) -> bool:
        """A simulated muscle cannot be hurt."""
        return self._points[0].rig.record.is_simulated

    def __call__(self, run: SweepRun, said: Annotation, record: Mapping[str, str]) -> Ending:
        """Run once, with a seed of its own: repeats under one seed would be copies."""
        settings = self._points[run.number]
        settings = settings.model_copy(update={"seed": settings.seed + run.repeat})
        what = f"{bare_name(self._names['controller'])}-{bare_name(self._names['experiment'])}"
        with restore_signals():
            done = run_once(
                settings,
                self._names,
                make_dated_path(self._folder, what),
                self._progress(),
                quiet=True,
                said=said,
                records={SWEEP: record},
            )
        return Ending(ExitCode(done.code), done.reason or done.note)
