"""Search gains, or score given ones, in worker processes; and what is said of the result."""

from __future__ import annotations

import signal
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from pamctl.cluster.worker_processes import start_workers
from pamctl.control.law_registry import find_law, installed_laws
from pamctl.errors import ConfigError, Problem
from pamctl.exit_codes import ExitCode
from pamctl.log.run_meta import bare_name
from pamctl.new_file import NewFileError, require_place, write_files
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
    BOUNDS,
    GainsTrial,
    GainsVerdict,
    Member,
    draw_ensemble,
    make_fixed_members,
)

_DEFAULT_SIZE = 16
_FRESH = 200
_FRESH_SEED_OFFSET = 1_000_003
"""Added to the seed for plants that the search has not seen."""


WHOLE = GainsTrial("whole")


class TuningWishes(Protocol):
    """The options of `pamctl tune` that settle which plants judge, and where a search begins."""

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
    whole_trial: GainsTrial = WHOLE
    """What the score rests on: the paper's two experiments, or the motion that was asked for."""

    @property
    def trial(self) -> GainsTrial:
        """How gains are judged in a search: on a few named plants by the whole experiments."""
        return replace(self.whole_trial, length="short" if self.drawn else "whole")

    @property
    def elite_trial(self) -> GainsTrial | None:
        """What the best gains of a search on drawn plants must stand as well."""
        return self.whole_trial if self.drawn and not self.whole_trial.own_motion else None

    @classmethod
    def of(
        cls,
        asked: TuningWishes,
        law: str | None,
        base: RunSettings | None = None,
        *,
        own_motion: bool = False,
    ) -> TuningTask:
        """Make a task of the options of `pamctl tune` for a law; raise `ConfigError`.

        `base` has the rig that is simulated, and with `own_motion` the experiment that is judged.
        """
        checked = None if asked.check is None else _read("controller", asked.check, "--check")
        law = checked.law if checked is not None else law or ""
        if law not in installed_laws():
            known = ", ".join(installed_laws())
            raise _option_error(f"--law {law}".strip(), f"must be one of {known}")
        if checked is None:
            _require_space(law)
            _require_new(asked.out)
        elif asked.compensate:
            checked = checked.model_copy(update={"compensate": tuple(asked.compensate)})
        read = [(bare_name(name), _read_plant(name, base)) for name in asked.plants]
        named = make_fixed_members(read)
        draws = asked.size is not None or not asked.plants
        if asked.compensate and draws:
            raise _option_error(
                f"--compensate {asked.compensate[0]}",
                "undoes what a plant file says: give --plant FILE, and no --ensemble",
            )
        _require_undoable(asked.compensate, named, base)
        whole = WHOLE
        if base is not None:
            simulated = _simulate_rig(base, own_motion=own_motion)
            whole = GainsTrial("whole", simulated.model_dump_json(), own_motion)
        fresh_ones = _FRESH if checked is None or asked.size is None else asked.size
        return cls(
            law=law,
            drawn=draw_ensemble(asked.size or _DEFAULT_SIZE, asked.seed) if draws else [],
            named=named,
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


def _require_undoable(
    names: Sequence[str], members: Sequence[Member], base: RunSettings | None
) -> None:
    """Refuse what a run on one of the plants would refuse."""
    base = base or resolve()
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
    errors_um: Mapping[str, float]
    """Of the plant with the median score; empty where safety ended its run."""

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
        errors_um=sorted(verdicts, key=lambda verdict: verdict.worst)[len(ratios) // 2].figures_um,
    )


def format_gains_file(
    gains: Mapping[str, Any], command: str, effort: str, reported: str, *, own_motion: bool = False
) -> str:
    """Return the text of a controller file; the arguments after the gains are for its header."""
    law = find_law(str(gains["law"]))
    below = "only the proportion counts" if own_motion else "below 1 is inside"
    paragraphs = [
        f"{law.title}: {law.equation}. Units: mm, s, V.",
        f"Made by:  {command}",
        f"{effort} {reported}",
        f"Score: the largest of every error over {_name_scale(own_motion)} "
        f"(max {BOUNDS.max_m * 1e6:g}, RMS {BOUNDS.rms_m * 1e6:g}, steady "
        f"{BOUNDS.steady_m * 1e6:g} um; experiment 2 RMS {BOUNDS.moving_rms_m * 1e6:g} um); "
        f"{below}. Cost: the score plus a tenth of the mean of these errors, of the "
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


def report_scores(task: TuningTask, found: Mapping[str, Scores]) -> str:
    """Return how good the gains are, for the gains file."""
    if not found:
        return "Not scored: interrupted."
    own = task.whole_trial.own_motion
    said = [
        f"on {one.plants} {_PLANT_SET_NAMES[which]} {_describe_score(one, own_motion=own)}, "
        f"score median {one.median:.2f}, 95 % {one.p95:.2f}, worst {one.worst:.2f}"
        for which, one in found.items()
    ]
    what = "Own experiment" if own else "Both experiments in full"
    return f"{what}: {'; '.join(said)}."


def _name_scale(own_motion: bool) -> str:
    """Return what errors are divided by: for a motion of one's own it is a scale, and no bound."""
    table = "the strictest column of Table IV"
    return f"that of the paper's own motion in {table}" if own_motion else f"its bound in {table}"


def _describe_score(one: Scores, *, own_motion: bool) -> str:
    """Return how good gains are: inside Table IV, or for a motion of one's own the errors."""
    if not own_motion:
        return f"{one.inside} inside Table IV ({100 * one.share:.1f} %)"
    if not one.errors_um:
        return "safety ended the run"
    return ", ".join(f"{_ERROR_NAMES[name]} {um:.1f} µm" for name, um in one.errors_um.items())


def report_gains(
    task: TuningTask, scores: Mapping[str, Scores], document: Mapping[str, object]
) -> Report:
    """Return how good gains are; `document` says more of them, for programs."""
    whole = {"law": task.law, **document, "scores": _make_scores_document(scores)}
    report = Report(f"Gains of {task.law}", document=whole)
    if not scores:
        report.verdict = "not scored"
    own = task.whole_trial.own_motion
    for which, one in scores.items():
        verdict = f"{task.law}, {_PLANT_SET_NAMES[which]}: "
        if own:
            verdict += _describe_score(one, own_motion=True)
        else:
            verdict += (
                f"{one.inside} of {one.plants} inside every "
                f"bound of Table IV ({100 * one.share:.1f} %)"
            )
        if report.verdict:
            report.add(Section(verdict))
        report.verdict = report.verdict or verdict
        report.add(
            Text(
                f"largest error over {'that of the paper' if own else 'its bound'}: "
                f"median {one.median:.2f}, 95 % {one.p95:.2f}, worst {one.worst:.2f}"
            )
        )
        if one.errors_um and not own:
            errors = ", ".join(f"{name} {um:.1f} µm" for name, um in one.errors_um.items())
            report.add(Text(f"errors on the median plant: {errors}"))
        failures = [f for f in one.failures if not own or f[1] not in _ERROR_NAMES]
        shown = failures[:_SHOWN_FAILURES]
        outside = [f"outside: plant {n}: {_describe_failure(why, w)}" for n, why, w in shown]
        if len(failures) > _SHOWN_FAILURES:
            outside.append(f"and {len(failures) - _SHOWN_FAILURES} more")
        if outside:
            report.add(Points(outside))
    return report


def _describe_failure(why: str, worst: float) -> str:
    """Say which error is too large; `why` is such as "max 1", or the name of an ending."""
    kind, _, experiment = why.rpartition(" ")
    if why in _ERROR_NAMES:
        return f"{_ERROR_NAMES[why]} is {worst:.2f} times the bound"
    if kind not in _ERROR_NAMES:
        return why
    return f"{_ERROR_NAMES[kind]} of experiment {experiment} is {worst:.2f} times the paper's"


def _make_scores_document(found: Mapping[str, Scores]) -> dict[str, Any] | None:
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
    with WorkProgress("tune") as progress, start_workers(jobs, cluster) as executor:
        return _score_gains(executor, task.checked, task, progress)


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
    began_s, ending = time.monotonic(), ExitCode.OK
    scores: dict[str, Scores]
    with _stop_on_signals(), WorkProgress("tune") as show, start_workers(jobs, cluster) as executor:
        search = GainsSearch(
            task.law,
            Jury(tuple(task.drawn), tuple(task.named)),
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
                progress(search.advance(executor), time.monotonic() - began_s)
        except KeyboardInterrupt as stop:
            if not search.generation:
                raise SystemExit(_name_ending(stop)) from None
            ending = _name_ending(stop)
        best = search.best
        controller = SECTIONS["controller"].validate_python(best.gains)
        try:
            scores = _score_gains(executor, controller, task, show)
        except KeyboardInterrupt as stop:  # a second one: the gains are written without scores
            ending, scores = _name_ending(stop), {}
    effort = describe_effort(task, best)
    text = format_gains_file(
        best.gains,
        command,
        effort,
        report_scores(task, scores),
        own_motion=task.whole_trial.own_motion,
    )
    failure = None
    try:
        write_files({task.out: text})
    except NewFileError as error:
        failure = error
    return FoundGains(best, scores, time.monotonic() - began_s, ending, text, failure)


@contextmanager
def _stop_on_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the search as Ctrl-C does: with the best so far."""

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {n: signal.signal(n, stop) for n in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _name_ending(stop: KeyboardInterrupt) -> ExitCode:
    return ExitCode(128 + stop.args[0]) if stop.args else ExitCode.SIGINT


def _score_gains(
    executor: Executor, controller: Any, task: TuningTask, show: WorkProgress
) -> dict[str, Scores]:
    """Return the scores on the fresh plants and on the named ones, where there are any."""
    verdict = partial(task.whole_trial.verdict, controller)
    members = [*task.fresh, *task.named]
    verdicts = []
    for each in executor.map(verdict, members, chunksize=max(1, len(members) // 50)):
        verdicts.append(each)
        show(len(verdicts), len(members), f"scored on {len(verdicts)} of {len(members)} plants")
    drawn = len(task.fresh)
    parts = {"fresh": slice(drawn), "named": slice(drawn, None)}
    return {
        which: summarise_verdicts(members[part], verdicts[part])
        for which, part in parts.items()
        if members[part]
    }
