"""Examine `pamctl diagnose` on rigs with a hidden effect, and print the results.

    python scripts/hidden_suite.py --subset quick|all|GROUP[,GROUP...] [--only TEXT]
        [--program short] [--null-each 100] [--seeds 1] [--workers 2] [--results FILE] [--json]
    python scripts/hidden_suite.py --oracle

Results are appended to a JSONL file, one line a case, and stored cases are not run again: an
examination of hours can be stopped and resumed. The table, the confusion matrix and every miss
go to stdout (markdown, or one JSON document), progress to stderr. `--oracle` computes which effects
each excitation can show at all (`tests/hidden/examination/oracle.json`).
"""

from __future__ import annotations

import argparse
import json
import sys
import traceback
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "scripts")]

from pamctl.realtime.scheduling import keep_single_threaded  # noqa: E402

keep_single_threaded()  # as `pamctl` does; before numpy is imported

from hidden.examination.cases import Case, all_cases, quick_cases  # noqa: E402
from hidden.examination.examine import examine  # noqa: E402
from hidden.examination.oracle import oracle  # noqa: E402
from hidden.examination.scoring import ORACLE, Result, confusion, figures, table  # noqa: E402
from hidden.excitations import PROGRAMS  # noqa: E402
from resumable_study import run_resumable  # noqa: E402

GOOD = ("right", "right_set", "silent", "honest", "twin")
ORACLE_PROGRAMS = ("standard", "short", "brief", "squares", "closed_loop")


def choose_cases(options: argparse.Namespace) -> list[Case]:
    """Return the selected cases."""
    if options.subset == "quick":
        cases: Iterable[Case] = quick_cases()
    else:
        groups = options.subset.split(",")
        cases = [
            case
            for case in all_cases(options.null_each, options.seeds)
            if options.subset == "all" or case.group in groups
        ]
    wanted = [case for case in cases if options.only in case.id]
    # Cases of a mechanism without air, or of squares only, do not suit another program.
    return [
        replace(case, program=options.program)
        if options.program and case.program == "standard"
        else case
        for case in wanted
    ]


def key(case: Case) -> str:
    """Return the key of a case in the results."""
    return f"{case.id}#{case.repeat}@{case.program}"


def examine_case(case: Case) -> dict[str, Any]:
    """Run one case; a crash of the diagnosis is a result too."""
    try:
        return {"key": key(case), **examine(case)}
    except Exception:
        return {"key": key(case), "error": traceback.format_exc(limit=-4)}


def describe_verdict(result: dict[str, Any]) -> str:
    """Return the verdict, for the progress line."""
    return str(result.get("document", {}).get("verdict", "CRASH"))


def format_oracle(every: dict[str, dict[str, dict[str, dict[str, float]]]]) -> str:
    """Return the oracle as JSON, one line for each size of an effect."""
    programs = []
    for program, effects in every.items():
        rows = []
        for name, sizes in effects.items():
            lines = ",\n".join(f'   "{size}": {json.dumps(row)}' for size, row in sizes.items())
            rows.append(f'  "{name}": {{\n{lines}\n  }}')
        programs.append(f' "{program}": {{\n' + ",\n".join(rows) + "\n }")
    return "{\n" + ",\n".join(programs) + "\n}\n"


def report(results: list[Result], crashed: list[str]) -> str:
    """Return the full report in markdown, with every miss."""
    parts = [table(figures(results)), confusion(results), "Not right:"]
    for result in results:
        if result.mark not in GOOD:
            answer = result.answer
            said = f"{answer.verdict} {sorted(answer.names)}"
            groups = [sorted(group) for group in answer.ambiguous]
            parts.append(
                f"- `{key(result.case)}` {sorted(result.case.effects)}: {result.mark}: "
                f"{said}{f', sets {groups}' if groups else ''}"
            )
    parts += [f"- `{name}`: the diagnosis crashed" for name in crashed]
    return "\n\n".join(parts[:3]) + "\n" + "\n".join(parts[3:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--subset", default="quick")
    parser.add_argument("--only", default="", help="run only cases whose id contains this")
    parser.add_argument(
        "--program", choices=PROGRAMS, help="another excitation than the standard one"
    )
    parser.add_argument("--null-each", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, default=Path("logs/hidden.jsonl"))
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--oracle", action="store_true")
    options = parser.parse_args()
    if options.oracle:
        ORACLE.write_text(format_oracle({program: oracle(program) for program in ORACLE_PROGRAMS}))
        return
    cases = choose_cases(options)
    tasks = {key(case): case for case in cases}
    found = run_resumable(tasks, examine_case, options.results, options.workers, describe_verdict)
    results = [
        Result(case, found[key(case)]["document"], found[key(case)]["seconds"])
        for case in cases
        if "document" in found[key(case)]
    ]
    crashed = [key(case) for case in cases if "error" in found[key(case)]]
    if options.json:
        print(json.dumps({"figures": [asdict(f) for f in figures(results)],
                          "marks": {key(r.case): r.mark for r in results},
                          "crashed": crashed}, indent=2))  # fmt: skip
    else:
        print(report(results, crashed))


if __name__ == "__main__":
    main()
