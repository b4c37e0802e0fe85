"""Make the runs of a sweep that are not there yet, and read what is there from their logs.

The logs are the only memory of a sweep: each carries its name as a tag, and its place in it. A
sweep that was interrupted goes on from there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from pamctl.exit_codes import Ending, ExitCode
from pamctl.json_text import to_json
from pamctl.log.annotation import Annotation
from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_row import RunRow
from pamctl.sweep.sweep_plan import SweepError, SweepRun

_INTERRUPTED = (ExitCode.SIGINT, ExitCode.SIGTERM, ExitCode.SIGHUP)

Tell = Callable[[str], object]
"""Called with one line before each run, and after one that did not end well."""


class SweepRunner(Protocol):
    """Makes one run, by itself or through the daemon."""

    def __call__(self, run: SweepRun, said: Annotation, record: Mapping[str, str]) -> Ending:
        """Run to the end; `said` and the metadata `record` go into its log."""

    @property
    def goes_on(self) -> bool:
        """Whether the next run may follow one that failed: not where a real muscle moves."""


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


def run_sweep(sweep: SweepPlan, runner: SweepRunner, tell: Tell) -> SweepEnd:
    """Make the runs that are missing; return all that there are.

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
        try:
            ended = runner(run, said, _make_record(sweep, run))
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
    with RunIndex(sweep.folder) as index:
        index.refresh()
        rows = index.select("json_extract(sweep, '$.name') = ?", [sweep.name])
    if any(row.sweep["base"] != sweep.base for row in rows):
        raise SweepError(
            f"the sweep {sweep.name} in {sweep.folder} was made with other settings or other keys; "
            "give this one another --name"
        )
    places = {run.place for run in sweep.runs}
    found: dict[str, RunRow] = {}
    for row in rows:
        place = SweepRun(row.sweep["point"], row.sweep["repeat"], 0).place
        if place in places and (row.ending == "ok" or (whatever_ending and place not in found)):
            found[place] = row
    return found


def _make_record(sweep: SweepPlan, run: SweepRun) -> dict[str, str]:
    point = to_json(run.point).decode()
    return {"name": sweep.name, "base": sweep.base, "point": point, "repeat": str(run.repeat)}
