"""Examine `pamctl diagnose` on what a laboratory meets first, and print the marks.

    python scripts/hostile_suite.py [--only TEXT] [--group GROUP] [--size small|large]
        [--excitation open|closed|random] [--limit N] [--seed N] [--resume FILE] [--jobs N]
        [--cpu-limit-s S]
        [--list | --visible]

The cases are in `tests/hidden/hostile/situations.py`. Results are appended to a JSONL file, one
line a case, and stored cases are not run again. The JSON document goes to stdout, the table and
the progress to stderr. `--limit N` draws N cases at random, the same ones for the same `--seed`.
`--visible` computes from the truths alone what a recalibration leaves of each small fault
(`tests/hidden/hostile/visible.json`).
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import sys
import traceback
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "scripts")]

from pamctl.realtime.scheduling import keep_single_threaded  # noqa: E402

keep_single_threaded()  # as `pamctl` does; before numpy is imported

from hidden.hostile.marking import HONEST, RIGHT, MarkedCase, Said, summarize  # noqa: E402
from hidden.hostile.programs import EXCITATIONS  # noqa: E402
from hidden.hostile.situations import SIZES, HostileCase, all_cases  # noqa: E402
from hidden.hostile.trial import examine  # noqa: E402
from hidden.hostile.visible import STORED, is_hopeless, measure_share  # noqa: E402
from resumable_study import run_resumable  # noqa: E402


def choose_cases(options: argparse.Namespace) -> list[HostileCase]:
    """Return the selected cases."""
    chosen = [
        case
        for case in all_cases()
        if options.only in case.id
        and options.group in ("", case.situation.group)
        and options.size in ("", case.size)
        and options.excitation in ("", case.excitation)
    ]
    if options.limit and options.limit < len(chosen):
        drawn = set(random.Random(options.seed).sample(range(len(chosen)), options.limit))
        chosen = [case for k, case in enumerate(chosen) if k in drawn]
    return chosen


def format_shares(cases: Iterable[HostileCase]) -> str:
    """Return what a recalibration leaves of the small faults that must be named, as JSON."""
    asked = (c for c in cases if c.size == "small" and not c.answer.silent and not c.answer.noise)
    lines = [f' "{case.id}": {measure_share(case):.3f}' for case in asked]
    return "{\n" + ",\n".join(lines) + "\n}\n"


class OutOfTime(Exception):
    """A case took more processor time than it may."""


def examine_case(case: HostileCase, limit_s: float) -> dict[str, Any]:
    """Run one case; a crash of the diagnosis is a result too, and so is one that does not end."""

    def stop(*_: object) -> None:
        raise OutOfTime

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, limit_s)  # processor time: others may use this PC too
    try:
        return {"key": case.id, **examine(case)}
    except OutOfTime:
        return {"key": case.id, "out_of_time_s": limit_s}
    except Exception:
        return {"key": case.id, "error": traceback.format_exc(limit=-4)}
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def describe_said(result: Mapping[str, Any]) -> str:
    """Return verdict, names and set-up findings in one line."""
    if "error" in result:
        return f"CRASH {result['error'].splitlines()[-1]}"
    if "out_of_time_s" in result:
        return f"no answer within {result['out_of_time_s']:g} s"
    said = Said.of(result["document"])
    words = [said.verdict, *sorted(said.names)]
    words += [f"{{{', '.join(sorted(group))}}}" for group in said.sets]
    words += [f"[{f['kind']} {f['number']} {f.get('value', '')}]" for f in said.findings]
    return " ".join([*words, f"({said.noise})"] if said.noise else words)


def describe_asked(case: HostileCase) -> str:
    """Return what is to be said of a case, in one line."""
    answer = case.answer
    words = [*sorted(answer.effects), *answer.noise]
    words += [f"[{c.kind} {c.number} {'' if c.value is None else c.value}]" for c in answer.setup]
    if answer.unknown:
        words.append("nothing known")
    if answer.silent or is_hopeless(case):
        words.append("or nothing" if words else "nothing")
    return " ".join(words)


def format_table(results: Sequence[MarkedCase], without: Mapping[str, str]) -> str:
    """Return the shares by group in markdown, and every case that is not right."""
    rows = [
        "| group | cases | right | honest | missed | wrong | noise not there |",
        "|---|---|---|---|---|---|---|",
    ]
    for group, n in summarize(results).items():
        rows.append(f"| {group} | {n['cases']} | {n['right']:.0%} | {n['honest']:.0%} "
                    f"| {n['missed']:.0%} | {n['wrong']} | {n['noise_not_there']} |")  # fmt: skip
    counts = Counter(r.mark for r in results)
    rows.append(", ".join(f"{word} {count}" for word, count in counts.most_common()))
    for result in results:
        if result.mark not in RIGHT:
            said = describe_said({"document": result.document})
            asked = describe_asked(result.case)
            rows.append(f"- `{result.case.id}`: {result.mark}: {said}; asked: {asked}")
    return "\n".join([*rows, *(f"- `{name}`: {words}" for name, words in without.items())])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", default="", help="only cases whose id contains this")
    parser.add_argument("--group", default="")
    parser.add_argument("--size", choices=("", *SIZES), default="")
    parser.add_argument("--excitation", choices=("", *EXCITATIONS), default="")
    parser.add_argument("--limit", type=int, default=0, help="a random sample of this many")
    parser.add_argument("--seed", type=int, default=0, help="of the random sample")
    parser.add_argument("--resume", type=Path, default=Path("logs/hostile.jsonl"))
    parser.add_argument("--cpu-limit-s", type=float, default=1800.0, help="for a case")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--list", action="store_true", help="print the cases and stop")
    parser.add_argument("--visible", action="store_true", help="compute visible.json and stop")
    options = parser.parse_args()
    if options.visible:
        STORED.write_text(format_shares(all_cases()))
        return
    cases = choose_cases(options)
    if options.list:
        print("\n".join(case.id for case in cases))
        return
    tasks = {case.id: case for case in cases}
    run = partial(examine_case, limit_s=options.cpu_limit_s)
    found = run_resumable(tasks, run, options.resume, options.jobs, describe_said)
    results = [
        MarkedCase(case, found[case.id]["document"], found[case.id]["seconds"])
        for case in cases
        if "document" in found[case.id]
    ]
    without = {
        case.id: describe_said(found[case.id]) for case in cases if "document" not in found[case.id]
    }
    print(json.dumps({
        "summary": summarize(results),
        "good_marks": {"right": RIGHT, "honest": HONEST},
        "cases": {r.case.id: {"mark": r.mark, "seconds": r.seconds,
                              "said": describe_said({"document": r.document}),
                              "asked": describe_asked(r.case)}
                  for r in results},
        "without_answer": without,
    }, indent=2))  # fmt: skip
    print(format_table(results, without), file=sys.stderr)


if __name__ == "__main__":
    main()
