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

from pamctl.log.naming import bare
from pamctl.problems import ConfigError, Problem
from pamctl.realtime.ending import ExitCode
from pamctl.settings import SECTIONS, Raw, find, to_data, validated
from pamctl.tune.ensemble import Member, ensemble, fixed_members
from pamctl.tune.gains_file import Scores, gains_file, scores
from pamctl.tune.search import Found, Search, SearchError
from pamctl.tune.space import SPACES
from pamctl.tune.trial import Trial, Verdict

_DEFAULT_SIZE = 16
_FRESH = 1_000_003
"""Added to the seed for plants that the search has not seen."""
_SHOWN_FAILURES = 8


@dataclass(frozen=True)
class Asked:
    """What the options mean."""

    law: str
    members: list[Member]
    fresh: list[Member]
    """Plants for the score."""
    seed: int
    quantile: float
    out: Path | None
    checked: Any
    """Controller to score; None to seek one."""
    start: dict[str, Any] | None

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
    ) -> Asked:
        """Make sense of the options; raise `ConfigError`."""
        checked = None if check is None else _controller(check)
        law = checked.law if checked is not None else law
        if law not in SPACES:
            raise _wrong(f"--law {law or ''}".strip(), f"must be one of {', '.join(SPACES)}")
        if plants and size is not None:
            raise _wrong("--ensemble", "tune for given plants or for drawn ones, not both")
        if checked is None:
            _require_new(out)
        began = None if start is None else _controller(start)
        if began is not None and began.law != law:
            raise _wrong(f"--start {start}", f"holds gains of {began.law}, not of {law}")
        if began is not None and began.length_unit != "mm":
            raise _wrong(f"--start {start}", "gains are sought in mm, these are in inches")
        if plants:
            members = fixed_members([(bare(name), _plant(name)) for name in plants])
            fresh = members
        else:
            members = ensemble(size or _DEFAULT_SIZE, seed)
            fresh = ensemble(held_out, seed + _FRESH)
        begun = None if began is None else to_data(began)
        return cls(law, members, fresh, seed, quantile, out, checked, begun)


def _wrong(where: str, message: str) -> ConfigError:
    return ConfigError([Problem(where, "", message)])


def _require_new(out: Path | None) -> None:
    if out is None:
        raise _wrong("--out", "where shall the gains go? Name a file that does not exist yet")
    if out.exists():
        raise _wrong(f"--out {out}", "exists, and gains are never overwritten")
    if not out.parent.is_dir():
        raise _wrong(f"--out {out}", f"there is no directory {out.parent}")


def _controller(name: str) -> Any:
    return validated(SECTIONS["controller"], Raw.read(find("controller", name)), "controller")


def _plant(name: str) -> Any:
    return validated(SECTIONS["plant"], Raw.read(find("plant", name)), "plant")


def check_gains(asked: Asked, jobs: int | None, *, as_json: bool) -> ExitCode:
    """Score given gains on fresh plants and print how they did."""
    with _processes(jobs) as executor:
        found = _scored(executor, asked.checked, asked.fresh)
    document = {"law": asked.law, "gains": to_data(asked.checked), "scores": _document(found)}
    typer.echo(json.dumps(document, indent=2) if as_json else _told(asked.law, found))
    return ExitCode.OK


def seek_gains(
    asked: Asked, jobs: int | None, generations: int, command: str, *, as_json: bool
) -> ExitCode:
    """Search, write the gains and print how they do on plants the search has not seen."""
    assert asked.out is not None
    state = asked.out.with_suffix(".search.json")
    began_s = time.monotonic()
    interrupted = False
    found: Scores | None
    with _processes(jobs) as executor:
        try:
            search = Search(
                asked.law, asked.members, asked.seed, asked.quantile, asked.start, state
            )
            while search.generation < generations:
                _show(search.advance(executor), generations, began_s)
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
            found = _scored(executor, controller, asked.fresh)
        except KeyboardInterrupt:  # in no mood to wait: the gains all the same
            interrupted, found = True, None
    text = gains_file(best.gains, command, _effort(asked, best), _reported(asked, found))
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
        "scores": None if found is None else _document(found),
        "out": str(asked.out),
    }
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        typer.echo("not scored" if found is None else _told(asked.law, found))
        typer.echo(f"gains: {asked.out}")
    if interrupted:
        print(
            f"interrupted; without {asked.out} the same command goes on from {state}",
            file=sys.stderr,
        )
    return ExitCode.SIGINT if interrupted else ExitCode.OK


# --- processes -------------------------------------------------------------------------------


@contextmanager
def _processes(jobs: int | None) -> Iterator[ProcessPoolExecutor]:
    # Not forked: a fork of a process with numba's and numpy's threads may hang.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(jobs or os.cpu_count(), context, initializer=_begin_work)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def _begin_work() -> None:
    """Leave Ctrl-C to the one who shares the work out, and end when that one is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A worker waits on a pipe of which it holds both ends: it would wait there for ever.
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _scored(executor: ProcessPoolExecutor, controller: Any, members: Sequence[Member]) -> Scores:
    verdict = partial(_verdict, controller)
    found = list(executor.map(verdict, members, chunksize=max(1, len(members) // 50)))
    return scores(members, found)


def _verdict(controller: Any, member: Member) -> Verdict:
    return Trial("whole").verdict(controller, member)


# --- words -----------------------------------------------------------------------------------


def _show(best: Found, generations: int, began_s: float) -> None:
    took_s = time.monotonic() - began_s
    line = f"generation {best.generation} of {generations}: {best.cost:.3f}, {took_s:.0f} s"
    if sys.stderr.isatty():
        print(f"\r{line}   ", end="", file=sys.stderr, flush=True)
    else:
        print(line, file=sys.stderr, flush=True)


def _effort(asked: Asked, best: Found) -> str:
    kind = f"the quantile {asked.quantile:g}" if asked.quantile < 1.0 else "the worst"
    return (
        f"Differential evolution, {best.generation} generations, {best.evaluations} runs of 24 s, "
        f"for {kind} of {len(asked.members)} plants, which scored {best.cost:.3f}."
    )


def _reported(asked: Asked, found: Scores | None) -> str:
    if found is None:
        return "Not scored: interrupted."
    which = "the same plants" if asked.fresh is asked.members else "fresh plants"
    return (
        f"On {found.plants} {which}, both experiments in full: {found.inside} inside Table IV "
        f"({100 * found.share:.1f} %), score median {found.median:.2f}, 95 % {found.p95:.2f}, "
        f"worst {found.worst:.2f}."
    )


def _told(law: str, found: Scores) -> str:
    lines = [
        f"{law}: {found.inside} of {found.plants} plants inside every bound of Table IV "
        f"({100 * found.share:.1f} %)",
        f"largest error over its bound: median {found.median:.2f}, 95 % {found.p95:.2f}, "
        f"worst {found.worst:.2f}",
    ]
    for name, why, worst in found.failures[:_SHOWN_FAILURES]:
        lines.append(f"  outside: plant {name}: {why}, {worst:.2f} times the bound")
    if len(found.failures) > _SHOWN_FAILURES:
        lines.append(f"  and {len(found.failures) - _SHOWN_FAILURES} more")
    return "\n".join(lines)


def _document(found: Scores) -> dict[str, Any]:
    failures = [{"plant": n, "why": why, "worst": worst} for n, why, worst in found.failures]
    return {**found._asdict(), "share": found.share, "failures": failures}
