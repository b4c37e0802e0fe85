"""Make the runs of a sweep that are not there yet, and read what is there from their logs.

The logs are the only memory of a sweep: each carries its name as a tag, and its place in it. A
sweep that was interrupted goes on from there. Runs are made by `pamctl run`'s own means, or
through the daemon.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.daemon.client import Client, DaemonDeclinedError
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.daemon.requested_settings import change_gains, load_controller
from pamctl.exit_codes import Ending, ExitCode
from pamctl.json_text import to_json
from pamctl.log.annotation import SWEEP, Annotation
from pamctl.log.run_meta import bare_name, make_dated_path
from pamctl.processes.interrupts import restore_signals
from pamctl.processes.run_once import run_once
from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_row import RunRow, read_row
from pamctl.session.sweep_plan import SweepError, SweepRequest, SweepRun, list_runs
from pamctl.settings.resolve import RunSettings, settings_to_data

_INTERRUPTED = (ExitCode.SIGINT, ExitCode.SIGTERM, ExitCode.SIGHUP)

Tell = Callable[[str], object]
"""Called with one line before each run, and after one that did not end well."""


class SweepPlan(NamedTuple):
    """What is to be run, and where the logs are."""

    name: str
    """Also the tag of its logs."""
    base: str
    """Mark of all settings that are not swept."""
    runs: Sequence[SweepRun]
    folder: Path
    said: Annotation
    """What is said of every run, without the tag."""


class SweepEnd(NamedTuple):
    """How a sweep ended."""

    ending: Ending
    rows: Sequence[RunRow]
    """The runs of the plan that are in the folder, in the order of the plan."""
    left: int
    """Number of runs that are still to be made."""


def run_sweep(sweep: SweepPlan, runner: OwnRunner | DaemonRunner, tell: Tell) -> SweepEnd:
    """Make the runs that are missing; return all that there are.

    The next run follows one that failed only where the runner `goes_on`: not where a real muscle
    moves.

    Raise SweepError if the folder holds a sweep of this name with other settings.
    """
    done = find_runs(sweep)
    left = [run for run in sweep.runs if run.place not in done]
    if done:
        tell(f"sweep {sweep.name}: {len(done)} of {len(sweep.runs)} runs are there already")
    ending, failed = Ending(ExitCode.OK, ""), 0
    said = sweep.said.add_tag(sweep.name)
    for number, run in enumerate(left, 1):
        tell(f"run {number} of {len(left)}: {run.title}")
        point = to_json(run.point).decode()
        place = {"point": point, "repeat": str(run.repeat)}
        record = {"name": sweep.name, "base": sweep.base, **place}
        try:
            ended = runner(run, said, record)
        except KeyboardInterrupt:
            ended = Ending(ExitCode.SIGINT, "stopped by SIGINT")
        if ended.code in _INTERRUPTED or (ended.code and not runner.goes_on):
            ending = ended
            break
        if ended.code:
            failed += 1
            tell(f"this run ended with {int(ended.code)}: {ended.reason}")
    if not ending.code and failed:
        ending = Ending(ExitCode.CHECK_FAILED, f"{failed} of {len(left)} runs did not end well")
    found = find_runs(sweep, whatever_ending=True)
    well = find_runs(sweep)
    rows = [found[run.place] for run in sweep.runs if run.place in found]
    return SweepEnd(ending, rows, sum(1 for run in sweep.runs if run.place not in well))


def find_runs(sweep: SweepPlan, *, whatever_ending: bool = False) -> dict[str, RunRow]:
    """Return the runs of a sweep that are in its folder, by their place; the newest of each.

    Only those that ended well, unless asked for all. Raise SweepError as `run_sweep` does.
    """
    index = RunIndex(sweep.folder)
    index.refresh()
    rows = [row for row in index.select() if row.sweep.get("name") == sweep.name]
    if any(row.sweep["base"] != sweep.base for row in rows):
        raise SweepError(
            f"the sweep {sweep.name} in {sweep.folder} was made with other settings or other keys; "
            "give this one another --name"
        )
    places = {run.place for run in sweep.runs}
    found: dict[str, RunRow] = {}
    for row in rows:
        place = SweepRun(row.sweep["point"], row.sweep["repeat"], 0).place
        is_better = whatever_ending and (place not in found or found[place].ending != "ok")
        if place in places and (row.ending == "ok" or is_better):
            found[place] = row
    return found


class OwnRunner:
    """Makes each run with its own processes. The muscle is homed again before each."""

    def __init__(
        self,
        points: Sequence[RunSettings],
        names: Mapping[str, str],
        folder: Path,
        shows_progress: bool,
    ) -> None:
        """`points` are the settings of each point, by its number."""
        self._points = points
        self.goes_on = points[0].rig.record.is_simulated
        self._names = dict(names)
        self._folder = folder
        self._shows_progress = shows_progress

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
                quiet=True,
                shows_progress=self._shows_progress,
                said=said,
                records={SWEEP: record},
            )
        return Ending(ExitCode(done.code), done.reason or done.note)


_LOOK_EVERY_S = 0.1


class DaemonRunner:
    """Asks a daemon for each run; a context manager that puts the gains back at its end."""

    goes_on = False
    """A fault of the daemon waits for a person, who acknowledges it."""

    def __init__(self, client: Client, settings: RunSettings, name: str) -> None:
        """Of `settings` only experiment and duration count; `name` is that of the experiment.

        Raise SweepError where the daemon is not free.
        """
        self._client, self._settings, self._name = client, settings, name
        self._experiment = settings_to_data(settings.experiment)
        status = client.call("status")
        if status["state"] not in ("idle", "ready") or status["run"] is not None:
            raise SweepError(f"the daemon is not free: its state is {status['state']}")
        self._gains: dict[str, Any] = status["controller"]
        self._folder = Path(status["logs"])
        self._device = status["device"]
        self._names = status["names"]

    def plan_sweep(
        self, request: SweepRequest, repeats: int, name: str, said: Annotation
    ) -> SweepPlan:
        """Return what is to be run; raise SweepError where the daemon could not run it."""
        others = [key for key in request.swept if not key.startswith("controller.")]
        if wrong := [*others, *request.fixed]:
            why = "on the daemon only keys of the controller are swept, and nothing else is set"
            raise SweepError(f"--set {wrong[0]}: {why}")
        known = {
            "controller": self._gains,
            "experiment": self._experiment,
            "duration_s": self._settings.duration_s,
            "device": self._device,
        }
        try:
            now = load_controller(self._settings, self._gains, "the gains of the daemon")
            changed = [change_gains(now, point) for point in request.list_points()]
        except RequestRefusedError as error:
            raise SweepError(str(error)) from error
        points = [request.read_point(settings_to_data(settings)) for settings in changed]
        mark = request.mark_base(known)
        return SweepPlan(name, mark, list_runs(points, repeats), self._folder, said)

    def __enter__(self) -> DaemonRunner:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Put the gains back."""
        with suppress(DaemonDeclinedError):
            params = {"controller": self._gains, "name": self._names["controller"], "ramp_s": 0.0}
            self._client.call("load", params)

    def __call__(self, run: SweepRun, said: Annotation, record: Mapping[str, str]) -> Ending:
        """Set the gains, start, and wait for the log; an interrupt stops the run smoothly."""
        changes = [f"{key}={value}" for key, value in run.point.items()]
        self._client.call("set", {"changes": changes, "ramp_s": 0.0})
        log = Path(
            self._client.call(
                "start",
                {
                    "experiment": self._experiment,
                    "name": self._name,
                    "duration_s": self._settings.duration_s,
                    **asdict(said),
                    "sweep": record,
                },
            )["log"]
        )
        try:
            status = self._await_end(log)
        except KeyboardInterrupt:
            with suppress(DaemonDeclinedError):
                self._client.call("stop")
            self._await_end(log)
            raise
        row = read_row(log)
        code = ExitCode.UNEXPECTED if row.exit_code is None else ExitCode(row.exit_code)
        return Ending(code, status["fault"] or row.reason)

    def _await_end(self, log: Path) -> dict[str, Any]:
        while True:
            status: dict[str, Any] = self._client.call("status")
            if status["log"] != str(log):
                return status
            time.sleep(_LOOK_EVERY_S)
