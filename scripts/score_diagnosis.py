"""Score a diagnosis on 24 rigs that share no code with it, and put cores side by side.

    python scripts/score_diagnosis.py [--cases short|nulls|hostile|suite|quick] [--seeds 1,2]
        [--only PATTERN] [--core today | MODULE:FUNCTION]
        [--change cut:2,half_rate,guess:0.5,units] [--jobs 2] [--results FILE] [--list]

A seed draws the short list: singles in turn over the catalogue, pairs, halves of the smallest size,
nulls, hostile, dirty and uncatalogued rigs, and two measured seals (below the folder that
PAMCTL_MEASURED_DATA names). The other lists are whole suites: their table has only what is not
right; `quick` is a few of `suite`, all hidden rigs. A core is one function,
`diagnose_case(records, plant) -> Said` (`tests/hidden/rungs.py`), with records as (to fit, to judge
by) and the plant file's content; names to take out of the catalogue come third, where a case has
them. Results are appended to a JSONL file; what is stored is not run again, and the table shows
every core in the file. With `--change` the same records come in other words, and places, kinds,
names and numbers are compared with those of the plain ones.
"""

from __future__ import annotations

import argparse
import importlib
import re
import signal
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "scripts")]

from pamctl.realtime.scheduling import keep_single_threaded  # noqa: E402

keep_single_threaded()  # as `pamctl` does; before numpy is imported

from hidden.changes import CHANGES, compare_said  # noqa: E402
from hidden.read_document import read_document  # noqa: E402
from hidden.rungs import Said, mark  # noqa: E402
from hidden.score_list import LISTS, Handed, ScoredCase  # noqa: E402
from resumable_study import read_stored, run_resumable  # noqa: E402

LONGEST = 100
"""Cases of which every one has a row."""

Core = Callable[..., Said]


def diagnose_today(records: Handed, plant: Mapping[str, Any], without: Sequence[str] = ()) -> Said:
    """Ask `pamctl.diagnose`; what it says in its document, in the words of `rungs`."""
    from pamctl.diagnose import Record, diagnose
    from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
    from pamctl.plant.model import PlantSettings

    train, held_out = ([Record(name=r.name, **r.columns()) for r in part] for part in records)
    settings = PlantSettings.model_validate(plant)
    document = build_diagnosis_document(diagnose(train, held_out, settings, without=without))
    return read_document(document)


def find_core(name: str) -> Core:
    """Return a core by name."""
    if name == "today":
        return diagnose_today
    module, _, function = name.partition(":")
    core: Core = getattr(importlib.import_module(module), function)
    return core


@dataclass(frozen=True)
class Task:
    """One case before one core, with its records in other words or not."""

    case: ScoredCase
    core: str
    change: str
    limit_s: float

    @property
    def key(self) -> str:
        """Its name in the results."""
        return "@".join([self.case.key, self.core, *([self.change] if self.change else [])])


class OutOfTime(Exception):
    """A case took more processor time than it may."""


def run_task(task: Task) -> dict[str, Any]:
    """Diagnose one case; a crash is a result too, and so is a case without an end."""

    def stop(*_: object) -> None:
        raise OutOfTime

    signal.signal(signal.SIGPROF, stop)
    about = {"key": task.key, "case": task.case.key, "core": task.core, "change": task.change,
             "group": task.case.group}  # fmt: skip
    try:
        handed, plant = task.case.make()
        causes = task.case.causes
        name, _, value = task.change.partition(":")
        if name:
            handed, plant = CHANGES[name](handed, plant, float(value or 0.0))
        asked = [f"{c.what} ({c.rung})" for c in causes]
        began = process_time()
        signal.setitimer(signal.ITIMER_PROF, task.limit_s)
        left_out = [task.case.without] if task.case.without else []
        said = find_core(task.core)(handed, plant, *left_out)
        spent = process_time() - began
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        verdict, false = mark(causes, said, task.case.ignored)
        verdict = task.case.correct_verdict(verdict, said)
        return about | {"verdict": verdict, "false": false, "asked": asked, "words": said.words(),
                        "said": _as_plain(said), "cpu_s": round(spent, 1)}  # fmt: skip
    except OutOfTime:
        return about | {"verdict": "no answer", "false": [], "asked": [], "words": "no answer",
                        "said": _as_plain(Said()), "cpu_s": task.limit_s}  # fmt: skip
    except Exception:
        return about | {"error": traceback.format_exc(limit=-6)}
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def _as_plain(said: Said) -> dict[str, Any]:
    return asdict(said) | {
        "names": sorted(said.names), "sets": [sorted(group) for group in said.sets],
        "places": sorted(said.places), "noise": sorted(said.noise),
    }  # fmt: skip


def said_of(result: Mapping[str, Any]) -> Said:
    """Return what a stored result says."""
    s = result["said"]
    return Said(
        frozenset(s["names"]), tuple(map(frozenset, s["sets"])),
        frozenset((p, k) for p, k in s["places"]),
        {name: tuple(n) for name, n in s["numbers"].items()}, frozenset(s.get("noise", ())),
        s["refusal"], s.get("admits", False),
    )  # fmt: skip


def format_scores(results: Sequence[Mapping[str, Any]]) -> str:
    """Return a table, one row a case and one column a core; then what each core comes to."""
    cores = list(dict.fromkeys(r["core"] for r in results))
    rows = ["| case | truth (rung) |" + "".join(f" {core} | s |" for core in cores),
            "|---|---|" + "---|---|" * len(cores)]  # fmt: skip
    by_case: dict[str, dict[str, Mapping[str, Any]]] = {}
    groups = list(dict.fromkeys(r["group"] for r in results))
    for r in results:
        by_case.setdefault(r["case"], {})[r["core"]] = r
    for case, by_core in by_case.items():
        if len(by_case) > LONGEST and all(map(_is_right, by_core.values())):
            continue
        asked = next((r["asked"] for r in by_core.values() if r.get("asked")), [])
        cells = [f"| {case} | {', '.join(asked) or 'nothing'} |"]
        for core in cores:
            r = by_core.get(core)
            cells.append(f" {_cell(r)} | {r.get('cpu_s', '') if r else ''} |")
        rows.append("".join(cells))
    for core in cores:
        mine = [r for r in results if r["core"] == core]
        seconds = sorted(r["cpu_s"] for r in mine if "cpu_s" in r)
        counts = Counter(r.get("verdict", "CRASH") for r in mine)
        good = {g: [_is_right(r) for r in mine if r["group"] == g] for g in groups}
        shares = ", ".join(f"{g} {sum(right)}/{len(right)}" for g, right in good.items())
        middle = seconds[len(seconds) // 2] if seconds else 0.0
        rows.append(
            f"\n{core}: {sum(map(_is_right, mine))} of {len(mine)} right ({shares}); "
            f"{dict(counts)}; processor seconds "
            f"{sum(seconds):.0f} in all, median {middle}, worst {max(seconds, default=0)}"
        )
    return "\n".join(rows)


def _is_right(result: Mapping[str, Any]) -> bool:
    return str(result.get("verdict", "")).startswith(("right", "silent"))


def _cell(result: Mapping[str, Any] | None) -> str:
    if result is None:
        return ""
    if "error" in result:
        return f"CRASH {result['error'].splitlines()[-1][:80]}"
    return f"**{result['verdict']}**: {result['words'].replace('|', '/')[:150]}"


def format_changes(plain: Mapping[str, Any], results: Sequence[Mapping[str, Any]]) -> str:
    """Return which changes of words changed what was said."""
    rows = ["| case | change | differs |", "|---|---|---|"]
    same = 0
    for r in results:
        base = plain.get(f"{r['case']}@{r['core']}")
        if base is None or "error" in r:
            rows.append(f"| {r['case']} | {r['change']} | {_cell(r) or 'no plain result'} |")
            continue
        differs = compare_said(said_of(base), said_of(r))
        same += not differs
        if differs:
            rows.append(f"| {r['case']} | {r['change']} | {'; '.join(differs)[:220]} |")
    return "\n".join([*rows, f"\n{same} of {len(results)} say the same"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", default="1")
    parser.add_argument("--cases", choices=LISTS, default="short", help="which list")
    parser.add_argument("--core", default="today")
    parser.add_argument("--only", default="", help="only cases whose name has this pattern")
    parser.add_argument("--change", default="", help=f"of {', '.join(CHANGES)}; NAME:VALUE")
    parser.add_argument("--results", type=Path, default=Path("logs/score.jsonl"))
    parser.add_argument("--cpu-limit-s", type=float, default=300.0, help="for a case")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--list", action="store_true", help="print the cases and stop")
    given = parser.parse_args()
    cases = [c for seed in map(int, given.seeds.split(",")) for c in LISTS[given.cases](seed)
             if re.search(given.only, c.key)]  # fmt: skip
    if given.list:
        print("\n".join(case.key for case in cases))
        return
    changes = [change for change in given.change.split(",") if change]
    plain = [Task(case, given.core, "", given.cpu_limit_s) for case in cases]
    tasks = [*plain, *(replace(t, change=change) for t in plain for change in changes)]
    found = run_resumable({t.key: t for t in tasks}, run_task, given.results, given.jobs,
                          partial(_cell))  # fmt: skip
    keys = {case.key for case in cases}
    stored = {**read_stored(given.results), **found}
    chosen = [r for r in stored.values() if r["case"] in keys]
    order = {case.key: k for k, case in enumerate(cases)}
    chosen.sort(key=lambda r: order[r["case"]])
    print(format_scores([r for r in chosen if not r["change"]]))
    if changes:
        print(format_changes(stored, [r for r in chosen if r["change"] in changes]))


if __name__ == "__main__":
    main()
