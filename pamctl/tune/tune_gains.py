"""What `pamctl tune` does: processes, progress, and the file that says how it was made."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import typer

from pamctl.control.law_registry import installed_laws
from pamctl.exit_codes import ExitCode
from pamctl.log.naming import bare_name
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    find_config_file,
    settings_to_data,
    validate_settings,
)
from pamctl.tune.gains_file import Scores, format_gains_file, summarise_verdicts
from pamctl.tune.gains_search import BestGains, GainsSearch, Jury, SearchError
from pamctl.tune.gains_trial import GainsTrial, GainsVerdict
from pamctl.tune.plant_ensemble import Member, draw_ensemble, make_fixed_members
from pamctl.tune.search_space import find_space

_DEFAULT_SIZE = 16
_FRESH_SEED_OFFSET = 1_000_003
"""Added to the seed for plants that the search has not seen."""
_SHOWN_FAILURES = 8
_PLANT_SET_NAMES = {"fresh": "fresh plants", "named": "named plants"}


@dataclass(frozen=True)
class TuningTask:
    """What is to be tuned, as the options say."""

    law: str
    drawn: list[Member]
    """Plants of which the quantile counts."""
    named: list[Member]
    """Plants that all count."""
    fresh: list[Member]
    """Drawn plants for the score. The search does not use them."""
    seed: int
    quantile: float
    out: Path | None
    checked: Any
    """Controller to score; None to search for one."""
    start: dict[str, Any] | None

    @property
    def trial(self) -> GainsTrial:
        """How a search judges gains; a few named plants run the whole experiments."""
        return GainsTrial("short" if self.drawn else "whole")

    @property
    def jury(self) -> Jury:
        """The plants of the search."""
        return Jury(tuple(self.drawn), self.quantile, tuple(self.named))

    @classmethod
    def of(
        cls,
        law: str | None,
        plants: Sequence[str],
        size: int | None,
        seed: int,
        quantile: float,
        held_out: int,
        out: Path | None,
        check: str | None,
        start: str | None,
    ) -> TuningTask:
        """Make sense of the options; raise `ConfigError`."""
        checked = None if check is None else _read_controller(check, "--check")
        law = checked.law if checked is not None else law or ""
        if law not in installed_laws():
            known = ", ".join(installed_laws())
            raise _option_error(f"--law {law}".strip(), f"must be one of {known}")
        if checked is None:
            _require_space(law)
            _require_new(out)
        began = None if start is None else _read_controller(start, "--start")
        if began is not None and began.law != law:
            raise _option_error(f"--start {start}", f"holds gains of {began.law}, not of {law}")
        if began is not None and began.length_unit != "mm":
            raise _option_error(f"--start {start}", "gains are sought in mm, these are in inches")
        named = make_fixed_members([(bare_name(name), _read_plant(name)) for name in plants])
        draws = size is not None or not plants
        drawn = draw_ensemble(size or _DEFAULT_SIZE, seed) if draws else []
        fresh = draw_ensemble(held_out, seed + _FRESH_SEED_OFFSET) if draws else []
        begun = None if began is None else settings_to_data(began)
        return cls(law, drawn, named, fresh, seed, quantile, out, checked, begun)


def _option_error(where: str, message: str) -> ConfigError:
    return ConfigError([Problem(where, "", message)])


def _require_space(law: str) -> None:
    try:
        find_space(law)
    except ValueError as error:
        raise _option_error(f"--law {law}", str(error)) from None


def _require_new(out: Path | None) -> None:
    if out is None:
        raise _option_error("--out", "name a file for the gains that does not exist yet")
    if out.exists():
        raise _option_error(f"--out {out}", "exists, and gains are never overwritten")
    if not out.parent.is_dir():
        raise _option_error(f"--out {out}", f"there is no directory {out.parent}")


def _read_controller(name: str, option: str) -> Any:
    raw = RawSettings.read(find_config_file("controller", name, option))
    return validate_settings(SECTIONS["controller"], raw, "controller")


def _read_plant(name: str) -> Any:
    return validate_settings(
        SECTIONS["plant"], RawSettings.read(find_config_file("plant", name)), "plant"
    )


def check_gains(asked: TuningTask, jobs: int | None, *, as_json: bool) -> ExitCode:
    """Score given gains on fresh plants, or on named ones, and print how they did."""
    with _start_processes(jobs) as executor:
        found = _score_gains(executor, asked.checked, asked)
    document = {"law": asked.law, "gains": settings_to_data(asked.checked), **_make_document(found)}
    typer.echo(json.dumps(document, indent=2) if as_json else _format_scores(asked.law, found))
    return ExitCode.OK


def seek_gains(
    asked: TuningTask, jobs: int | None, generations: int, command: str, *, as_json: bool
) -> ExitCode:
    """Search, write the gains and print how they do on plants the search has not seen."""
    assert asked.out is not None
    state = asked.out.with_suffix(".search.json")
    began_s = time.monotonic()
    interrupted = False
    found: dict[str, Scores]
    with _start_processes(jobs) as executor:
        try:
            search = GainsSearch(asked.law, asked.jury, asked.seed, asked.start, state, asked.trial)
            while search.generation < generations:
                _show_progress(search.advance(executor), generations, began_s)
        except SearchError as error:
            print(f"error: {error}", file=sys.stderr)
            return ExitCode.USAGE
        except KeyboardInterrupt:
            interrupted = True
        try:
            best = search.best
        except SearchError as error:
            print(f"\nerror: stopped before the first generation: {error}", file=sys.stderr)
            return ExitCode.SIGINT
        controller = SECTIONS["controller"].validate_python(best.gains)
        try:
            found = _score_gains(executor, controller, asked)
        except KeyboardInterrupt:  # the gains are kept, without a score
            interrupted, found = True, {}
    text = format_gains_file(
        best.gains, command, _describe_effort(asked, best), _report_scores(found)
    )
    with asked.out.open("x") as file:
        file.write(text)
    if not interrupted:
        state.unlink(missing_ok=True)
    document = {
        "law": asked.law,
        "gains": best.gains,
        "cost": best.cost,
        "generations": best.generation,
        "runs": best.evaluations,
        "took_s": time.monotonic() - began_s,
        "interrupted": interrupted,
        **_make_document(found),
        "out": str(asked.out),
    }
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        typer.echo(_format_scores(asked.law, found) if found else "not scored")
        typer.echo(f"gains: {asked.out}")
    if interrupted:
        print(
            f"interrupted; without {asked.out} the same command goes on from {state}",
            file=sys.stderr,
        )
    return ExitCode.SIGINT if interrupted else ExitCode.OK


# --- processes -------------------------------------------------------------------------------


@contextmanager
def _start_processes(jobs: int | None) -> Iterator[ProcessPoolExecutor]:
    # Not forked: a fork of a process with numba's and numpy's threads may hang.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(jobs or os.cpu_count(), context, initializer=_begin_work)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def _begin_work() -> None:
    """Ignore Ctrl-C, which the parent handles, and end when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A worker waits on a pipe whose both ends it holds: without this it would wait for ever.
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _score_gains(
    executor: ProcessPoolExecutor, controller: Any, asked: TuningTask
) -> dict[str, Scores]:
    """Return scores on fresh plants and on the named ones, where there are any."""
    verdict = partial(_judge_member, controller)
    members = [*asked.fresh, *asked.named]
    verdicts = list(executor.map(verdict, members, chunksize=max(1, len(members) // 50)))
    drawn = len(asked.fresh)
    parts = {"fresh": slice(drawn), "named": slice(drawn, None)}
    return {
        which: summarise_verdicts(members[part], verdicts[part])
        for which, part in parts.items()
        if members[part]
    }


def _judge_member(controller: Any, member: Member) -> GainsVerdict:
    return GainsTrial("whole").verdict(controller, member)


# --- words -----------------------------------------------------------------------------------


def _show_progress(best: BestGains, generations: int, began_s: float) -> None:
    took_s = time.monotonic() - began_s
    line = f"generation {best.generation} of {generations}: {best.cost:.3f}, {took_s:.0f} s"
    if sys.stderr.isatty():
        print(f"\r{line}   ", end="", file=sys.stderr, flush=True)
    else:
        print(line, file=sys.stderr, flush=True)


def _describe_effort(asked: TuningTask, best: BestGains) -> str:
    kind = f"the quantile {asked.quantile:g}" if asked.quantile < 1.0 else "the worst"
    drawn = f"{kind} of {len(asked.drawn)} drawn plants" if asked.drawn else ""
    named = " and ".join(member.name for member in asked.named)
    judges = ", and for ".join(filter(None, [drawn, named]))
    return (
        f"Differential evolution, {best.generation} generations, {best.evaluations} runs of "
        f"{asked.trial.duration_s:g} s, for {judges}; cost {best.cost:.3f}."
    )


def _report_scores(found: dict[str, Scores]) -> str:
    if not found:
        return "Not scored: interrupted."
    said = [
        f"on {one.plants} {_PLANT_SET_NAMES[which]} {one.inside} inside Table IV "
        f"({100 * one.share:.1f} %), "
        f"score median {one.median:.2f}, 95 % {one.p95:.2f}, worst {one.worst:.2f}"
        for which, one in found.items()
    ]
    return f"Both experiments in full: {'; '.join(said)}."


def _format_scores(law: str, found: dict[str, Scores]) -> str:
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
        lines.append(f"  outside: plant {name}: {why}, {worst:.2f} times the bound")
    if len(found.failures) > _SHOWN_FAILURES:
        lines.append(f"  and {len(found.failures) - _SHOWN_FAILURES} more")
    return "\n".join(lines)


def _make_document(found: dict[str, Scores]) -> dict[str, Any]:
    return {"scores": {which: _score_fields(one) for which, one in found.items()} or None}


def _score_fields(found: Scores) -> dict[str, Any]:
    failures = [{"plant": n, "why": why, "worst": worst} for n, why, worst in found.failures]
    return {**found._asdict(), "share": found.share, "failures": failures}
