"""Measure what a diagnosis costs: processor time and simulations, by phase; two versions in turn.

    python scripts/bench_diagnose.py [--before COMMIT] [--cases readme,pair,null,none_known]
        [--rounds 1] [--json]

The records are made once, by rigs of `tests/hidden` (`readme` is the example of README.md). Every
diagnosis runs in a process of its own. Before each, ten million additions in a Python loop are
timed: processors that other programs share are slower at times. With `--before` the same records
are diagnosed by another commit, in turn with this one, and by the same interpreter. Seconds of
processor time include the start of the process; the first round compiles, and does not count.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CASES = {
    "null": "null",
    "pair": "pair",
    "none_known": "left_out/polytropic",
}
"""Cases of `tests/hidden` by the beginning of their names; the first that fits is taken."""
PHASES = ("_mend_records", "weigh_evidence", "audit_evidence", "_decide_next")
"""Steps of `pamctl.diagnose.workflow`; what is in none of them is `other`."""
YARDSTICK = "total = 0\nfor number in range(10_000_000):\n    total += number"


def make_records(name: str, folder: Path) -> Path:
    """Write the records of a case: columns of the training and of the held-out runs."""
    path = folder / f"{name.replace('/', '_').replace('#', '_')}.pickle"
    made = _run_readme(folder) if name == "readme" else _run_hidden(name)
    path.write_bytes(pickle.dumps(made))
    return path


def _run_readme(folder: Path) -> dict[str, Any]:
    plant = folder / "mine.yaml"
    plant.write_text("effects:\n  valve_deadband: {fill_width_v: 0.25, exhaust_width_v: 0.2}\n")
    logs = []
    for seed in (1, 2):
        logs.append(str(folder / f"run-{seed}.mcap"))
        subprocess.run(
            [sys.executable, "-m", "pamctl", "run", "--experiment", "diagnosis", "--fast",
             "--plant", plant, "--seed", str(seed), "--set", f"experiment.seed={seed}",
             "--log", logs[-1]],
            cwd=ROOT, check=True, capture_output=True,
        )  # fmt: skip
    return {"logs": ([logs[0]], [logs[1]]), "without": ()}


def _run_hidden(name: str) -> dict[str, Any]:
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    from dataclasses import replace

    from hidden.examination.cases import all_cases
    from hidden.examination.examine import records_of, start_plant

    case = next(c for c in all_cases(5, 1) if c.id.startswith(CASES.get(name, name)))
    if case.program == "standard":
        case = replace(case, program="brief")
    train, holdout = ([{"name": r.name, **r.columns()} for r in part] for part in records_of(case))
    plant = start_plant(case).model_dump(mode="json", exclude_none=True)
    return {"records": (train, holdout), "without": case.removed, "plant": plant}


def measure(path: Path) -> dict[str, Any]:
    """Diagnose a case in this process; return verdict, names, and what it cost."""
    began = process_time()
    exec(YARDSTICK, {})
    yardstick_s, began = process_time() - began, process_time()
    from pamctl.realtime.scheduling import keep_single_threaded

    keep_single_threaded()  # as `pamctl` does: idle threads of the algebra count as well
    from pamctl.diagnose import Record, diagnose, record_of, workflow
    from pamctl.diagnose.evidence import run_pieces
    from pamctl.plant.model import PlantSettings

    case = pickle.loads(path.read_bytes())
    if "logs" in case:
        given = [[record_of(Path(p)) for p in part] for part in case["logs"]]
        plant = PlantSettings()
    else:
        given = [[Record(**columns) for columns in part] for part in case["records"]]
        plant = PlantSettings.model_validate(case["plant"])
    start_s = process_time() - began
    spent, simulated, running = defaultdict(float), defaultdict(int), ["other"]

    def in_phase(name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*given: Any, **named: Any) -> Any:
            since, outside = process_time(), dict(spent)
            running.append(name)
            try:
                return work(*given, **named)
            finally:
                running.pop()
                inside = sum(spent[n] - outside.get(n, 0.0) for n in spent)
                spent[name] += process_time() - since - inside

        return timed

    def counting(work: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*given: Any, **named: Any) -> Any:
            simulated[running[-1]] += 1
            return work(*given, **named)

        return counted

    for name in PHASES:
        setattr(workflow, name, in_phase(name, getattr(workflow, name)))
    for name in ("drive_mechanics", "drive_coupled"):
        setattr(run_pieces, name, counting(getattr(run_pieces, name)))
    found = in_phase("other", diagnose)(*given, plant, without=case["without"])
    return {
        "verdict": str(found.verdict),
        "names": sorted(f.name for f in found.findings),
        "yardstick_s": round(yardstick_s, 3),
        "cpu_s": round(process_time() - began, 2),
        "simulations": sum(simulated.values()),
        "phases": {"start": round(start_s, 2)} | {n: round(s, 2) for n, s in spent.items()},
        "simulations_by_phase": dict(simulated),
    }


def run_apart(path: Path, code: Path) -> dict[str, Any]:
    """Measure a case with the package of a folder, in a process of its own."""
    kept = {n: v for n, v in os.environ.items() if n != "PYTHONDONTWRITEBYTECODE"}
    found = subprocess.run(  # modules are compiled once, as in an installed package
        [sys.executable, __file__, "--measure", str(path)],
        env={**kept, "PYTHONPATH": str(code)},
        cwd=code, check=True, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    answer: dict[str, Any] = json.loads(found.stdout)
    return answer


def take_out(commit: str, folder: Path) -> Path:
    """Write the files of a commit into a folder."""
    code = folder / "before"
    code.mkdir()
    packed = subprocess.run(
        ["git", "-C", str(ROOT), "archive", commit], check=True, capture_output=True
    )
    subprocess.run(["tar", "x", "-C", str(code)], input=packed.stdout, check=True)
    return code


def summarise(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the median of the rounds: seconds where the yardstick takes half a second, too."""
    scaled = [0.5 * r["cpu_s"] / r["yardstick_s"] for r in rounds]
    return {
        **rounds[-1],
        "cpu_s": round(median(r["cpu_s"] for r in rounds), 2),
        "scaled_s": round(median(scaled), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--before", metavar="COMMIT", help="compare with this commit")
    parser.add_argument("--cases", default="readme,pair,null,none_known")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(options.measure)))
        return
    results: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        versions = {"after": ROOT}
        if options.before:
            versions = {"before": take_out(options.before, folder), **versions}
        paths = {case: make_records(case, folder) for case in options.cases.split(",")}
        for code in versions.values():
            run_apart(next(iter(paths.values())), code)
        for case, path in paths.items():
            rounds: dict[str, list[dict[str, Any]]] = defaultdict(list)
            for _ in range(options.rounds):
                for version, code in versions.items():
                    rounds[version].append(run_apart(path, code))
            results[case] = {version: summarise(found) for version, found in rounds.items()}
            if not options.json:
                print_case(case, results[case])
    if options.json:
        print(json.dumps(results, indent=2))


def print_case(case: str, found: dict[str, Any]) -> None:
    """Print a case: a line for each version, and its phases."""
    for version, result in found.items():
        print(
            f"{case:12} {version:6} {result['verdict']} {','.join(result['names'])}: "
            f"{result['cpu_s']} s of processor time ({result['scaled_s']} s where the yardstick "
            f"takes 0.5 s), {result['simulations']} simulations"
        )
        for phase, seconds in result["phases"].items():
            count = result["simulations_by_phase"].get(phase, 0)
            print(f"    {phase:16} {seconds:7.2f} s {count:5d} simulations")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
