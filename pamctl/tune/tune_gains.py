"""Search gains, or score given ones, in worker processes; and what is said of the result."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.cluster.worker_processes import start_workers
from pamctl.control.law_registry import find_law, installed_laws
from pamctl.log.run_meta import bare_name
from pamctl.new_file import NewFileError, require_place, write_files
from pamctl.settings.config_files import find_config_file
from pamctl.settings.known_effects import build_compensation
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import (
    SECTIONS,
    read_section_file,
    require_muscle,
    resolve,
    settings_to_data,
)
from pamctl.settings.yaml12 import dump_yaml
from pamctl.tune.gains_search import QUANTILE, BestGains, GainsSearch, Jury, find_space
from pamctl.tune.gains_trial import (
    BOUNDS,
    GainsTrial,
    GainsVerdict,
    Member,
    draw_ensemble,
    make_fixed_members,
)

_DEFAULT_SIZE = 16
_DEFAULT_HELD_OUT = 200
_FRESH_SEED_OFFSET = 1_000_003
"""Added to the seed for plants that the search has not seen."""


@dataclass(frozen=True)
class TuningTask:
    """What is tuned, for which plants, and what judges the result."""

    law: str
    drawn: list[Member]
    """Plants of which a quantile counts."""
    named: list[Member]
    """Plants of which each counts."""
    fresh: list[Member]
    """Drawn plants for the score, none of which the search sees."""
    seed: int
    out: Path | None
    checked: Any
    """Controller to score; None to seek one."""
    start: dict[str, Any] | None
    compensate: tuple[str, ...] = ()
    """Effects that the gains undo, each with the numbers of the plant that it is judged on."""

    @property
    def trial(self) -> GainsTrial:
        """How gains are judged in a search: on a few named plants by the whole experiments."""
        return GainsTrial("short" if self.drawn else "whole")

    @property
    def elite_trial(self) -> GainsTrial | None:
        """What the best gains of a search on drawn plants must stand as well."""
        return GainsTrial("whole") if self.drawn else None

    @classmethod
    def of(
        cls,
        law: str | None,
        plants: Sequence[str],
        size: int | None,
        seed: int,
        held_out: int | None,
        out: Path | None,
        check: str | None,
        start: str | None,
        compensate: Sequence[str] = (),
    ) -> TuningTask:
        """Make a task of the options of `pamctl tune`; raise `ConfigError`."""
        checked = None if check is None else _read("controller", check, "--check")
        law = checked.law if checked is not None else law or ""
        if law not in installed_laws():
            known = ", ".join(installed_laws())
            raise _option_error(f"--law {law}".strip(), f"must be one of {known}")
        if checked is None:
            _require_space(law)
            _require_new(out)
        began = None if start is None else _read("controller", start, "--start")
        if began is not None and began.law != law:
            raise _option_error(f"--start {start}", f"holds gains of {began.law}, not of {law}")
        if began is not None and began.length_unit != "mm":
            raise _option_error(f"--start {start}", "the search works in mm, not in inches")
        named = make_fixed_members([(bare_name(name), _read_muscle(name)) for name in plants])
        draws = size is not None or not plants
        if compensate and draws:
            raise _option_error(
                f"--compensate {compensate[0]}",
                "undoes what a plant file says: give --plant FILE, and no --ensemble",
            )
        _require_undoable(compensate, named)
        if held_out is not None and not draws:
            message = "there are no fresh plants: with --plant, give --ensemble too"
            raise _option_error(f"--held-out {held_out}", message)
        drawn = draw_ensemble(size or _DEFAULT_SIZE, seed) if draws else []
        judges = held_out or _DEFAULT_HELD_OUT
        fresh = draw_ensemble(judges, seed + _FRESH_SEED_OFFSET) if draws else []
        begun = None if began is None else settings_to_data(began)
        if checked is not None and compensate:
            checked = checked.model_copy(update={"compensate": tuple(compensate)})
        names = tuple(compensate)
        return cls(law, drawn, named, fresh, seed, out, checked, begun, names)


def _option_error(where: str, message: str) -> ConfigError:
    return ConfigError([Problem(where, "", message)])


def _require_undoable(names: Sequence[str], members: Sequence[Member]) -> None:
    """Refuse what a run on one of the plants would refuse."""
    base = resolve()
    controller = base.controller.model_copy(update={"compensate": tuple(names)})
    for member in members:
        try:
            build_compensation(member.plant, base.rig, controller)
        except ValueError as error:
            raise _option_error(f"--compensate {' '.join(names)}", str(error)) from None


def _require_space(law: str) -> None:
    try:
        find_space(law)
    except ValueError as error:
        raise _option_error(f"--law {law}", str(error)) from None


def _require_new(out: Path | None) -> None:
    if out is None:
        raise _option_error("--out is required", "name a new file for the gains")
    require_place(out)


def _read_muscle(name: str) -> Any:
    plant = _read("plant", name)
    try:
        require_muscle(plant)
    except ValueError as error:
        raise ConfigError([Problem(name, "", str(error))]) from error
    return plant


def _read(section: str, name: str, option: str = "") -> Any:
    return read_section_file(section, find_config_file(section, name, option))


_WIDTH = 98


class Scores(NamedTuple):
    """How gains did on a set of plants."""

    plants: int
    inside: int
    """Plants on which every error is inside the strictest column of Table IV."""
    median: float
    p95: float
    worst: float
    failures: tuple[tuple[str, str, float], ...]
    """Name, reason and largest error over its bound of each plant that is not inside."""

    @property
    def share(self) -> float:
        """Share of the plants inside."""
        return self.inside / self.plants


def summarise_verdicts(members: Sequence[Member], verdicts: Sequence[GainsVerdict]) -> Scores:
    """Summarise verdicts, one for each plant."""
    ratios = sorted(verdict.worst for verdict in verdicts)
    outside = [
        (member.name, verdict.why, verdict.worst)
        for member, verdict in zip(members, verdicts, strict=True)
        if not verdict.is_inside
    ]
    return Scores(
        plants=len(ratios),
        inside=len(ratios) - len(outside),
        median=ratios[len(ratios) // 2],
        p95=ratios[min(len(ratios) - 1, round(0.95 * (len(ratios) - 1)))],
        worst=ratios[-1],
        failures=tuple(sorted(outside, key=lambda failure: -failure[2])),
    )


def format_gains_file(gains: Mapping[str, Any], command: str, effort: str, reported: str) -> str:
    """Return the text of a controller file; the arguments after the gains are for its header."""
    law = find_law(str(gains["law"]))
    paragraphs = [
        f"{law.title}: {law.equation}. Units: mm, s, V.",
        f"Made by:  {command}",
        f"{effort} {reported}",
        "Score: the largest of every error over its bound in the strictest column of Table IV "
        f"(max {BOUNDS.max_m * 1e6:g}, RMS {BOUNDS.rms_m * 1e6:g}, steady "
        f"{BOUNDS.steady_m * 1e6:g} um; experiment 2 RMS {BOUNDS.moving_rms_m * 1e6:g} um); "
        "below 1 is inside. Cost: the score plus a tenth of the mean of these errors, of the "
        "named plants and of the drawn ones added up. Simulated; nothing was measured on a rig.",
    ]
    lines: list[str] = []
    for paragraph in paragraphs:
        lines += [
            f"# {line}"
            for line in textwrap.wrap(
                paragraph, _WIDTH, break_long_words=False, break_on_hyphens=False
            )
        ]
    return "\n".join(lines) + "\n" + dump_yaml(dict(gains))


_SHOWN_FAILURES = 8
_ERROR_NAMES = {"max": "largest error", "RMS": "RMS error", "steady": "steady error"}
_PLANT_SET_NAMES = {"fresh": "fresh plants", "named": "named plants"}


def describe_effort(task: TuningTask, best: BestGains) -> str:
    """Return how the gains were found, for the gains file."""
    drawn = f"the quantile {QUANTILE:g} of {len(task.drawn)} drawn plants" if task.drawn else ""
    named = " and ".join(member.name for member in task.named)
    judges = ", and for ".join(filter(None, [drawn, named]))
    runs = f"{best.evaluations} runs of {task.trial.duration_s:g} s"
    if task.elite_trial is not None:
        runs += f" and {best.longer_evaluations} of {task.elite_trial.duration_s:g} s"
    return (
        f"Differential evolution, {best.generation} generations, {runs}, for {judges}; "
        f"cost {best.cost:.3f}."
    )


def report_scores(found: Mapping[str, Scores]) -> str:
    """Return how good the gains are, for the gains file."""
    if not found:
        return "Not scored: interrupted."
    said = [
        f"on {one.plants} {_PLANT_SET_NAMES[which]} {one.inside} inside Table IV "
        f"({100 * one.share:.1f} %), "
        f"score median {one.median:.2f}, 95 % {one.p95:.2f}, worst {one.worst:.2f}"
        for which, one in found.items()
    ]
    return f"Both experiments in full: {'; '.join(said)}."


def format_scores(law: str, found: Mapping[str, Scores]) -> str:
    """Return how good the gains are, for the terminal."""
    return "\n".join(
        _format_one_score(f"{law}, {_PLANT_SET_NAMES[which]}", one) for which, one in found.items()
    )


def _format_one_score(title: str, found: Scores) -> str:
    lines = [
        f"{title}: {found.inside} of {found.plants} inside every bound of Table IV "
        f"({100 * found.share:.1f} %)",
        f"largest error over its bound: median {found.median:.2f}, 95 % {found.p95:.2f}, "
        f"worst {found.worst:.2f}",
    ]
    for name, why, worst in found.failures[:_SHOWN_FAILURES]:
        lines.append(f"  outside: plant {name}: {_describe_failure(why, worst)}")
    if len(found.failures) > _SHOWN_FAILURES:
        lines.append(f"  and {len(found.failures) - _SHOWN_FAILURES} more")
    return "\n".join(lines)


def _describe_failure(why: str, worst: float) -> str:
    """Say which error is too large; `why` is such as "max 1", or the name of an ending."""
    kind, _, experiment = why.rpartition(" ")
    if kind not in _ERROR_NAMES:
        return why
    return f"{_ERROR_NAMES[kind]} of experiment {experiment} is {worst:.2f} times the paper's"


def make_scores_document(found: Mapping[str, Scores]) -> dict[str, Any] | None:
    """Return the scores as one document; None where there are none."""
    return {which: _score_fields(one) for which, one in found.items()} or None


def _score_fields(found: Scores) -> dict[str, Any]:
    failures = [{"plant": n, "why": why, "worst": worst} for n, why, worst in found.failures]
    return {**found._asdict(), "share": found.share, "failures": failures}


class FoundGains(NamedTuple):
    """The result of a search."""

    best: BestGains
    scores: dict[str, Scores]
    """On plants the search has not seen, and on named ones; empty where interrupted."""
    took_s: float
    interrupted: bool
    """Stopped by Ctrl-C; the best gains so far are written all the same."""
    text: str
    """The gains file."""
    failure: NewFileError | None
    """Why the gains file could not be written; None where it was."""


def check_gains(
    task: TuningTask, jobs: int | None, cluster: str | None = None
) -> dict[str, Scores]:
    """Score the given gains on fresh plants, or on named ones."""
    with start_workers(jobs, cluster) as executor:
        return _score_gains(executor, task.checked, task)


def search_gains(
    task: TuningTask,
    jobs: int | None,
    generations: int,
    command: str,
    progress: Callable[[BestGains, float], None],
    cluster: str | None = None,
) -> FoundGains:
    """Search, score the best gains on plants the search has not seen, and write them.

    `command` goes into the file as its origin; `progress` is called after each generation with
    the seconds so far. The plants run in `jobs` processes of this machine, or on the Dask cluster
    at the address `cluster`. Raises `ClusterError`, and `KeyboardInterrupt` where
    that comes before the end of the first generation.
    """
    assert task.out is not None
    began_s = time.monotonic()
    interrupted = False
    scores: dict[str, Scores]
    with start_workers(jobs, cluster) as executor:
        search = GainsSearch(
            task.law,
            Jury(tuple(task.drawn), tuple(task.named)),
            task.seed,
            task.start,
            task.trial,
            task.elite_trial,
            task.compensate,
        )
        try:
            while search.generation < generations:
                progress(search.advance(executor), time.monotonic() - began_s)
        except KeyboardInterrupt:
            if not search.generation:
                raise
            interrupted = True
        best = search.best
        controller = SECTIONS["controller"].validate_python(best.gains)
        try:
            scores = _score_gains(executor, controller, task)
        except KeyboardInterrupt:  # a second one: the gains are written without scores
            interrupted, scores = True, {}
    effort = describe_effort(task, best)
    text = format_gains_file(best.gains, command, effort, report_scores(scores))
    failure = None
    try:
        write_files({task.out: text})
    except NewFileError as error:
        failure = error
    return FoundGains(best, scores, time.monotonic() - began_s, interrupted, text, failure)


def _score_gains(executor: Executor, controller: Any, task: TuningTask) -> dict[str, Scores]:
    """Return the scores on the fresh plants and on the named ones, where there are any."""
    verdict = partial(_judge_member, controller)
    members = [*task.fresh, *task.named]
    verdicts = list(executor.map(verdict, members, chunksize=max(1, len(members) // 50)))
    drawn = len(task.fresh)
    parts = {"fresh": slice(drawn), "named": slice(drawn, None)}
    return {
        which: summarise_verdicts(members[part], verdicts[part])
        for which, part in parts.items()
        if members[part]
    }


def _judge_member(controller: Any, member: Member) -> GainsVerdict:
    return GainsTrial("whole").verdict(controller, member)
