"""The runs of a sweep: every combination of the swept values, and that as often as it is repeated.

All combinations are run once before any is repeated: a drift of the rig then spreads over all
values, and does not look like an effect of one. The logs are the only memory of a sweep: each
carries its name as a tag, and its place in it. A sweep that was interrupted goes on from there.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.control.experiment import plan_experiment
from pamctl.exit_codes import Ending, ExitCode
from pamctl.json_text import to_json
from pamctl.log.annotation import SWEEP, Annotation
from pamctl.log.run_meta import bare_name, make_dated_path
from pamctl.processes.interrupts import restore_signals
from pamctl.processes.run_once import run_once
from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_row import RunRow
from pamctl.settings.resolve import RunSettings, settings_to_data

_MOST_RUNS = 10_000
_KEY = re.compile(r"\s*([^=\s]+)\s*=\s*(.*)", re.DOTALL)


class SweepError(Exception):
    """A sweep cannot be made or continued. The message says why, and what to do."""

    exit_code = ExitCode.USAGE


class SweepRequest(NamedTuple):
    """What `--set` says: settings that are swept, and overrides that are the same in all runs."""

    swept: Mapping[str, Sequence[str]]
    """The values of each key, as they were written."""
    fixed: tuple[str, ...]

    def list_points(self) -> list[tuple[str, ...]]:
        """Return the overrides `key=value` of every combination, the last key fastest."""
        options = [[f"{key}={value}" for value in values] for key, values in self.swept.items()]
        return list(product(*options))

    def list_overrides(self) -> list[tuple[str, ...]]:
        """Return all overrides of every combination."""
        return [(*self.fixed, *point) for point in self.list_points()]

    def read_point(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the swept settings by key, as they were understood."""
        return {key: _read_setting(settings, key) for key in self.swept}

    def mark_base(self, settings: Mapping[str, Any]) -> str:
        """Return a short mark of all settings but the swept ones and the seed.

        A sweep is continued under the same settings only: else its runs could not be compared.
        """
        left = _leave_out(settings, {"seed", *self.swept})
        return hashlib.sha256(to_json(left)).hexdigest()[:16]


class SweepRun(NamedTuple):
    """One run of a sweep."""

    point: Mapping[str, Any]
    """The swept settings, by key."""
    repeat: int
    """From 0."""
    number: int
    """Number of the point, from 0."""

    @property
    def place(self) -> str:
        """What tells it from the other runs of the sweep."""
        return to_json([sorted(self.point.items()), self.repeat]).decode()

    @property
    def title(self) -> str:
        """Its settings, for people."""
        said = ", ".join(f"{key}={value}" for key, value in self.point.items())
        return f"{said}, repeat {self.repeat + 1}"


def parse_sweep(overrides: Sequence[str], repeats: int) -> SweepRequest:
    """Split overrides into swept and fixed ones: `key=1,2,3` is swept; raise SweepError.

    A comma within brackets or quotes belongs to the value.
    """
    swept: dict[str, list[str]] = {}
    fixed = []
    for override in overrides:
        found = _KEY.fullmatch(override)
        values = _split_values(found[2]) if found else []
        if found is None or len(values) < 2:
            fixed.append(override)
            continue
        key = found[1]
        if key in swept:
            raise SweepError(f"--set {override}: {key} is swept already; write all its values once")
        if "" in values:
            raise SweepError(f"--set {override}: a value is empty; write {key}=1,2,3")
        if len(set(values)) < len(values):
            raise SweepError(f"--set {override}: a value stands twice; repeat it with --repeat")
        swept[key] = values
    if not swept:
        raise SweepError(
            "nothing is swept; give a setting several values: --set controller.lambda_per_s=20,40"
        )
    request = SweepRequest(swept, tuple(fixed))
    if (runs := len(request.list_points()) * repeats) > _MOST_RUNS:
        raise SweepError(f"these are {runs} runs, {_MOST_RUNS} are allowed; sweep fewer values")
    return request


def _split_values(text: str) -> list[str]:
    values, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character in "[{":
            depth += 1
        elif character in "]}":
            depth -= 1
        if character == "," and not depth and not quote:
            values.append("")
        else:
            values[-1] += character
    return [value.strip() for value in values]


def list_runs(points: Sequence[Mapping[str, Any]], repeats: int) -> list[SweepRun]:
    """Return all runs in their order."""
    return [
        SweepRun(point, repeat, number)
        for repeat in range(repeats)
        for number, point in enumerate(points)
    ]


def require_end(settings: RunSettings) -> None:
    """Raise SweepError where a run would have no end."""
    if settings.duration_s is None and math.isinf(plan_experiment(settings.experiment).duration_s):
        raise SweepError("this experiment has no end; give each run a length with --duration")


def _read_setting(settings: Any, key: str) -> Any:
    for part in key.split("."):
        settings = settings.get(part) if isinstance(settings, Mapping) else None
    return settings


def _leave_out(settings: Mapping[str, Any], keys: set[str], above: str = "") -> dict[str, Any]:
    return {
        name: _leave_out(value, keys, f"{above}{name}.") if isinstance(value, Mapping) else value
        for name, value in sorted(settings.items())
        if f"{above}{name}" not in keys
    }


# --- making the runs that are not there yet ---------------------------------------------------

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


def run_sweep(sweep: SweepPlan, runner: OwnRunner, tell: Tell) -> SweepEnd:
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
