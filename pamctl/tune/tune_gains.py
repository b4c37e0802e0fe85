"""Search gains, or score given ones, in worker processes; and what is said of the result."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from pamctl.base.errors import ConfigError, ExitCode, Problem, end_on_signals, name_interrupt
from pamctl.base.new_file import NewFileError, require_place, write_files
from pamctl.base.worker_processes import start_workers
from pamctl.control.law_registry import find_law, installed_laws
from pamctl.log.run_meta import bare_name
from pamctl.report.progress_line import WorkProgress
from pamctl.report.report import Points, Report, Section, Text
from pamctl.settings.config_files import find_config_file
from pamctl.settings.known_effects import build_compensation
from pamctl.settings.resolve import (
    SECTIONS,
    RunSettings,
    read_section_file,
    require_drivable,
    require_free_axis,
    resolve,
    settings_to_data,
)
from pamctl.settings.yaml12 import dump_yaml
from pamctl.tune.gains_search import QUANTILE, BestGains, GainsSearch, Jury, find_space
from pamctl.tune.gains_trial import (
    MOVING,
    RESTING,
    GainsTrial,
    GainsVerdict,
    Member,
    draw_ensemble,
)

_DEFAULT_SIZE = 16
_FRESH = 200
_FRESH_SEED_OFFSET = 1_000_003
"""Added to the seed for plants that the search has not seen."""


class TuningWishes(Protocol):
    """The options of `pamctl tune` that settle which plants judge, and where a search begins."""

    law: str | None
    plants: list[str]
    size: int | None
    """Of the ensemble; without plants a usual one is drawn."""
    seed: int
    out: Path | None
    check: str | None
    start: str | None
    compensate: list[str]


@dataclass(frozen=True)
class TuningTask:
    """What is tuned, for which plants, and what judges the result."""

    law: str
    jury: Jury
    fresh: list[Member]
    """Drawn plants for the score, none of which the search sees."""
    seed: int
    out: Path | None
    checked: Any
    """Controller to score; None to seek one."""
    start: dict[str, Any] | None
    compensate: tuple[str, ...]
    """Effects that the gains undo, each with the numbers of the plant that it is judged on."""
    whole_trial: GainsTrial
    """What the score rests on: the paper's two experiments, or the motion that was asked for."""

    @property
    def trial(self) -> GainsTrial:
        """How gains are judged in a search: on a few named plants by the whole experiments."""
        return replace(self.whole_trial, length="short" if self.jury.drawn else "whole")

    @property
    def elite_trial(self) -> GainsTrial | None:
        """What the best gains of a search on drawn plants must stand as well."""
        is_needed = self.jury.drawn and not self.whole_trial.own_motion
        return self.whole_trial if is_needed else None

    @classmethod
    def of(
        cls, asked: TuningWishes, base: RunSettings | None = None, *, own_motion: bool = False
    ) -> TuningTask:
        """Make a task of the options of `pamctl tune`; raise `ConfigError`.

        `base` has the rig that is simulated, and with `own_motion` the experiment that is judged.
        """
        checked = None if asked.check is None else _read("controller", asked.check, "--check")
        law = asked.law or "" if checked is None else checked.law
        if law not in installed_laws():
            known = ", ".join(installed_laws())
            raise _option_error(f"--law {law}".strip(), f"must be one of {known}")
        if checked is None:
            try:
                find_space(law)
            except ValueError as error:
                raise _option_error(f"--law {law}", str(error)) from None
            if asked.out is None:
                raise _option_error("--out is required", "name a new file for the gains")
            require_place(asked.out)
        elif asked.compensate:
            checked = checked.model_copy(update={"compensate": tuple(asked.compensate)})
        named = [Member(bare_name(name), _read_plant(name, base)) for name in asked.plants]
        draws = asked.size is not None or not asked.plants
        if asked.compensate and draws:
            raise _option_error(
                f"--compensate {asked.compensate[0]}",
                "undoes what a plant file says: give --plant FILE, and no --ensemble",
            )
        _require_undoable(asked.compensate, named, base or resolve())
        whole = GainsTrial("whole")
        if base is not None:
            simulated = _simulate_rig(base, own_motion=own_motion)
            whole = GainsTrial("whole", simulated.model_dump_json(), own_motion)
        fresh_ones = _FRESH if checked is None or asked.size is None else asked.size
        drawn = draw_ensemble(asked.size or _DEFAULT_SIZE, asked.seed) if draws else []
        return cls(
            law,
            Jury(tuple(drawn), tuple(named)),
            fresh=draw_ensemble(fresh_ones, asked.seed + _FRESH_SEED_OFFSET) if draws else [],
            seed=asked.seed,
            out=asked.out,
            checked=checked,
            start=None if asked.start is None else _read_start(asked.start, law),
            compensate=tuple(asked.compensate),
            whole_trial=whole,
        )


def _read_start(name: str, law: str) -> dict[str, Any]:
    began = _read("controller", name, "--start")
    if began.law != law:
        raise _option_error(f"--start {name}", f"holds gains of {began.law}, not of {law}")
    if began.length_unit != "mm":
        raise _option_error(f"--start {name}", "the search works in mm, not in inches")
    return settings_to_data(began)


def _option_error(where: str, message: str) -> ConfigError:
    return ConfigError([Problem(where, "", message)])


def _simulate_rig(base: RunSettings, *, own_motion: bool) -> RunSettings:
    """Put a simulation in the place of a card: with its calibration, limits and rate."""
    if own_motion and getattr(base.experiment, "IS_VALVE", False):
        message = "moves the valve and tracks nothing: gains need a displacement to follow"
        raise _option_error("--experiment", message)
    if base.rig.record.is_simulated:
        return base
    kept = ("calibration", "limits", "envelope", "homing", "loop", "compensate")
    sim = resolve().rig.model_copy(update={name: getattr(base.rig, name) for name in kept})
    return base.model_copy(update={"rig": sim})


def _require_undoable(names: Sequence[str], members: Sequence[Member], base: RunSettings) -> None:
    """Refuse what a run on one of the plants would refuse."""
    controller = base.controller.model_copy(update={"compensate": tuple(names)})
    for member in members:
        try:
            build_compensation(member.plant, base.rig, controller)
        except ValueError as error:
            raise _option_error(f"--compensate {' '.join(names)}", str(error)) from None


def _read_plant(name: str, base: RunSettings | None) -> Any:
    plant = _read("plant", name)
    try:
        require_drivable(plant)
        if plant.actuator == "direct":
            require_free_axis((base or resolve()).rig)
    except ValueError as error:
        raise ConfigError([Problem(name, "", str(error))]) from error
    return plant


def _read(section: str, name: str, option: str = "") -> Any:
    return read_section_file(section, find_config_file(section, name, option))


# --- how good gains are -----------------------------------------------------------------------

_ERROR_NAMES = {"max": "largest error", "RMS": "RMS error", "steady": "steady error"}
_PLANT_SETS = {"fresh": "fresh plants", "named": "named plants"}


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
    errors_um: Mapping[str, float]
    """Of the plant with the median score; empty where safety ended its run."""

    @property
    def share(self) -> float:
        """Share of the plants inside."""
        return self.inside / self.plants

    def describe(self, *, own_motion: bool) -> str:
        """Say how good the gains are: inside Table IV, or for another motion the errors."""
        if not own_motion:
            return f"{self.inside} inside Table IV ({100 * self.share:.1f} %)"
        said = (f"{_ERROR_NAMES[name]} {um:.1f} µm" for name, um in self.errors_um.items())
        return ", ".join(said) or "safety ended the run"


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
        errors_um=sorted(verdicts, key=lambda verdict: verdict.worst)[len(ratios) // 2].figures_um,
    )


_WIDTH = 98


def format_gains_file(
    task: TuningTask, best: BestGains, scores: Mapping[str, Scores], command: str
) -> str:
    """Return the text of a controller file; its header says how the gains were found."""
    law, own = find_law(task.law), task.whole_trial.own_motion
    drawn, named = task.jury
    judges = [f"the quantile {QUANTILE:g} of {len(drawn)} drawn plants"] * bool(drawn)
    judges += [" and ".join(member.name for member in named)] * bool(named)
    runs = f"{best.evaluations} runs of {task.trial.duration_s:g} s"
    if task.elite_trial is not None:
        runs += f" and {best.longer_evaluations} of {task.elite_trial.duration_s:g} s"
    bound = "a length of its own" if own else "its bound in the strictest column of Table IV"
    scored = "; ".join(
        f"on {one.plants} {_PLANT_SETS[which]} {one.describe(own_motion=own)}, "
        f"score median {one.median:.2f}, 95 % {one.p95:.2f}, worst {one.worst:.2f}"
        for which, one in scores.items()
    )
    what = "Own experiment" if own else "Both experiments in full"
    paragraphs = [
        f"{law.title}: {law.equation}. Units: mm, s, V.",
        f"Made by:  {command}",
        f"Differential evolution, {best.generation} generations, {runs}, for "
        f"{', and for '.join(judges)}; cost {best.cost:.3f}. "
        + (f"{what}: {scored}." if scored else "Not scored: interrupted."),
        f"Score: the largest of every error over {bound} (max "
        f"{RESTING.max_m * 1e6:g}, RMS {RESTING.rms_m * 1e6:g}, steady "
        f"{RESTING.steady_m * 1e6:g} um; experiment 2 RMS {MOVING.rms_m * 1e6:g} um); "
        f"{'only the proportion counts' if own else 'below 1 is inside'}. Cost: the score plus a "
        "tenth of the mean of these errors, of the named plants and of the drawn ones added up. "
        "Simulated; nothing was measured on a rig.",
    ]
    wrap = partial(textwrap.wrap, width=_WIDTH, break_long_words=False, break_on_hyphens=False)
    lines = [f"# {line}" for paragraph in paragraphs for line in wrap(paragraph)]
    return "\n".join(lines) + "\n" + dump_yaml(dict(best.gains))


_SHOWN_FAILURES = 8
_NO_HOMING = (
    "Simulated from rest, without homing. A run homes first: where hysteresis or play remembers "
    "that, its errors differ. `pamctl run --fast --set rig.homing.enabled=false` gives these."
)


def report_gains(
    task: TuningTask, scores: Mapping[str, Scores], document: Mapping[str, object]
) -> Report:
    """Return how good gains are; `document` says more of them, for programs."""
    found = {which: _make_document(one) for which, one in scores.items()} or None
    whole = {"law": task.law, **document, "scores": found}
    report = Report(f"Gains of {task.law}", "" if scores else "not scored", document=whole)
    own = task.whole_trial.own_motion
    for which, one in scores.items():
        inside = f"{one.inside} of {one.plants} inside every bound of Table IV"
        said = one.describe(own_motion=True) if own else f"{inside} ({100 * one.share:.1f} %)"
        verdict = f"{task.law}, {_PLANT_SETS[which]}: {said}"
        report.add(*[Section(verdict)] * bool(report.verdict))
        report.verdict = report.verdict or verdict
        if own and task.whole_trial.leaves_homing_out:
            report.add(Text(_NO_HOMING))
        if not own:
            spread = f"median {one.median:.2f}, 95 % {one.p95:.2f}, worst {one.worst:.2f}"
            report.add(Text(f"largest error over its bound: {spread}"))
        elif one.plants > 1 and one.median > 0.0:
            spread = f"95 % {one.p95 / one.median:.2f}, worst {one.worst / one.median:.2f}"
            report.add(Text(f"errors over those of the median plant: {spread}"))
        if one.errors_um and not own:
            errors = ", ".join(f"{name} {um:.1f} µm" for name, um in one.errors_um.items())
            report.add(Text(f"errors on the median plant: {errors}"))
        failures = [f for f in one.failures if not own or f[1] not in _ERROR_NAMES]
        outside = [
            f"outside: plant {name}: {_describe_failure(why, worst)}"
            for name, why, worst in failures[:_SHOWN_FAILURES]
        ]
        if len(failures) > _SHOWN_FAILURES:
            outside.append(f"and {len(failures) - _SHOWN_FAILURES} more")
        report.add(*[Points(outside)] * bool(outside))
    return report


def _make_document(scores: Scores) -> dict[str, Any]:
    failures = [{"plant": n, "why": why, "worst": worst} for n, why, worst in scores.failures]
    return {**scores._asdict(), "share": scores.share, "failures": failures}


def _describe_failure(why: str, worst: float) -> str:
    """Say which error is too large; `why` is such as "max 1", or the name of an ending."""
    kind, _, experiment = why.partition(" ")
    if kind not in _ERROR_NAMES:
        return why
    of = f" of experiment {experiment}" * bool(experiment)
    return f"{_ERROR_NAMES[kind]}{of} is {worst:.2f} times the paper's"


# --- the work ---------------------------------------------------------------------------------


class FoundGains(NamedTuple):
    """The result of a search."""

    best: BestGains
    scores: dict[str, Scores]
    """On plants the search has not seen, and on named ones; empty where interrupted."""
    took_s: float
    ending: ExitCode
    """Stopped by Ctrl-C, SIGTERM or SIGHUP; the best gains so far are written all the same."""
    text: str
    """The gains file."""
    failure: NewFileError | None
    """Why the gains file could not be written; None where it was."""


def check_gains(
    task: TuningTask, jobs: int | None, cluster: str | None = None
) -> dict[str, Scores]:
    """Score the given gains on fresh plants, or on named ones."""
    with WorkProgress("tune") as progress, _share_work(jobs, cluster) as executor:
        return _score_gains(executor, task.checked, task, progress)


def search_gains(
    task: TuningTask,
    jobs: int | None,
    generations: int,
    command: str,
    cluster: str | None = None,
) -> FoundGains:
    """Search, score the best gains on plants the search has not seen, and write them.

    `command` goes into the file as its origin. The plants run in `jobs` processes of this machine,
    or on the Dask cluster at the address `cluster`. Raises `ClusterError`, and `SystemExit` where a
    signal comes before the end of the first generation.
    """
    assert task.out is not None
    began_s, ending = time.monotonic(), ExitCode.OK
    scores: dict[str, Scores] = {}
    with end_on_signals(), WorkProgress("tune") as show, _share_work(jobs, cluster) as executor:
        search = GainsSearch(
            task.law,
            task.jury,
            task.seed,
            task.start,
            task.trial,
            task.elite_trial,
            task.compensate,
        )

        def watch(share: float) -> None:
            best = f", best so far {search.best.cost:.3f}" if search.generation else ""
            doing = f"generation {search.generation + 1} of {generations}{best}"
            show(search.generation + share, generations, doing)

        search.watch = watch
        watch(0.0)
        try:
            while search.generation < generations:
                search.advance(executor)
        except KeyboardInterrupt as stop:
            ending = name_interrupt(stop)
            if not search.generation:
                raise SystemExit(ending) from None
        best = search.best
        controller = SECTIONS["controller"].validate_python(best.gains)
        try:
            scores = _score_gains(executor, controller, task, show)
        except KeyboardInterrupt as stop:  # a second one: the gains are written without scores
            ending = name_interrupt(stop)
    text, failure = format_gains_file(task, best, scores, command), None
    try:
        write_files({task.out: text})
    except NewFileError as error:
        failure = error
    return FoundGains(best, scores, time.monotonic() - began_s, ending, text, failure)


def _share_work(jobs: int | None, cluster: str | None) -> AbstractContextManager[Executor | None]:
    """Return the workers; None where one job is asked for, which this process does itself."""
    return nullcontext() if jobs == 1 else start_workers(jobs, cluster)


def _score_gains(
    executor: Executor | None, controller: Any, task: TuningTask, show: WorkProgress
) -> dict[str, Scores]:
    """Return the scores on the fresh plants and on the named ones, where there are any."""
    verdict = partial(task.whole_trial.verdict, controller)
    members = [*task.fresh, *task.jury.named]
    chunk = max(1, len(members) // 50)
    share_out = map if executor is None else partial(executor.map, chunksize=chunk)
    verdicts = []
    for each in share_out(verdict, members):
        verdicts.append(each)
        show(len(verdicts), len(members), f"scored on {len(verdicts)} of {len(members)} plants")
    parts = {"fresh": slice(len(task.fresh)), "named": slice(len(task.fresh), None)}
    return {
        which: summarise_verdicts(members[part], verdicts[part])
        for which, part in parts.items()
        if members[part]
    }
