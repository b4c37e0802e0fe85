"""How long a valve stays open after a process dies, and what the card costs a tick.

    python scripts/bench_guardian.py --rounds 10 > guardian.json
    python scripts/bench_guardian.py --rounds 10 --against ../other-checkout > pair.json

JSON on stdout, a table on stderr. First, runs in real time over the simulation and over the tests'
stand-in card; a signal ends one process of each at a random moment, see `fault_rounds.py`. The
stand-in starts four threads of its own, as a driver library may; a third bench has none. Then
undisturbed runs of both in turn: wake-up lateness, and the time of reading and writing in a tick.
The stand-in's registers are memory: its times are those of the nidaqmx package and of our code
around it, not those of a card. With `--against` every round of this checkout has a neighbour of
the other one, in turn first and second. A turn of all cases takes two minutes for each checkout on
a quiet machine: with `--minutes` no case begins later, and what was measured so far is printed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from itertools import product, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from fault_rounds import Amiss, Bench, Run, benches, round_of, summary

from pamctl.log.reader import read

ROOT = Path(__file__).resolve().parents[1]
CASES = {
    ("loop", "killed"): 20.0,
    ("loop", "frozen"): 100.0,
    ("guardian", "killed"): 100.0,
    ("guardian", "frozen"): 100.0,
    ("recorder", "killed"): 100.0,
    ("front", "killed"): 100.0,
}
"""Process and signal, and the limit for the time to the safe voltage in ms."""


def deaths(
    both: list[Bench], folder: Path, rounds: int, roots: list[Path], until_s: float
) -> dict[str, Any]:
    """Time from a signal to the safe voltage, and ticks lost, for every process and checkout.

    Checkouts stand side by side in every case; none begins after `until_s` of the monotonic clock.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    card = both[1]
    bare = card._replace(environment={**card.environment, "STANDIN_THREADS": "0"})
    named = {"sim": both[0], "nidaq": card, "nidaq without foreign threads": bare}
    wanted = [(name, *case) for name in named for case in CASES]
    targets_ms: dict[str, float] = {}
    turns = product(range(rounds), wanted)  # in turn, so that all see the same PC
    for index, (name, process, how) in takewhile(lambda _: time.monotonic() < until_s, turns):
        for root in roots if index % 2 == 0 else roots[::-1]:
            log = folder / f"{name}-{process}-{how}-{roots.index(root)}-{index}.mcap"
            log = log.with_name(log.name.replace(" ", "-"))
            case = f"{name}, {process} {how}" + (f", {root}" if len(roots) > 1 else "")
            bench = use_checkout(named[name], root)
            found.setdefault(case, []).append(one_death(bench, process, how, log))
            print(f"{index + 1} of {rounds}: {case}: {found[case][-1]}", file=sys.stderr)
            targets_ms[case] = CASES[process, how]
    report = {
        case: {**summary(found[case]), "target_ms": target_ms}
        for case, target_ms in sorted(targets_ms.items())
    }
    for case, row in report.items():
        times_ms = row["safe_after_ms"]
        print(
            f"{case}: safe voltage after {times_ms['p50']:.1f} ms (p50), {times_ms['max']:.1f} ms "
            f"(max), target {row['target_ms']:.0f}; {row['ticks_lost']} ticks lost; "
            f"{row['well']} of {row['rounds']} rounds correct {row['amiss'] or ''}",
            file=sys.stderr,
        )
    return report


def use_checkout(bench: Bench, root: Path) -> Bench:
    """Return a bench whose runs take pamctl from this folder."""
    path = os.pathsep.join(filter(None, (str(root), bench.environment.get("PYTHONPATH"))))
    return bench._replace(environment={**bench.environment, "PYTHONPATH": path})


def one_death(bench: Bench, process: str, how: str, log: Path) -> dict[str, Any]:
    """Run one round; on a busy PC a run may end before its signal, which is reported."""
    try:
        return round_of(bench, [(process, how)], log)
    except (Amiss, subprocess.TimeoutExpired) as amiss:
        return {"amiss": str(amiss)}


def run_undisturbed(bench: Bench, log: Path, seconds: float) -> np.ndarray:
    """Run without a fault; one row a tick: lateness, read, write (s). Raises `Amiss`."""
    run = Run(bench, log, "--duration", str(seconds))
    _, said = run.front.communicate()
    if run.front.returncode:
        raise Amiss(said.decode().strip())
    ticks = read(log)
    return np.column_stack([ticks["late_s"], ticks["read_s"], ticks["write_s"]])


def ticks(both: list[Bench], timed: Bench, folder: Path, rounds: int) -> dict[str, Any]:
    """Lateness and I/O of undisturbed ticks, the backends in turn.

    A run that ended early, as on a machine that starves it, is counted and named.
    """
    chosen = {"sim": both[0], "nidaq on_demand": both[1], "nidaq hardware_timed": timed}
    rows: dict[str, list[np.ndarray]] = {name: [] for name in chosen}
    amiss: dict[str, list[str]] = {name: [] for name in chosen}
    for index in range(rounds):
        for name, bench in chosen.items():
            log = folder / f"quiet-{name}-{index}.mcap".replace(" ", "-")
            try:
                rows[name].append(run_undisturbed(bench, log, 2.0))
            except Amiss as reason:
                amiss[name].append(str(reason))
    report: dict[str, Any] = {}
    for name, runs in rows.items():
        report[name] = {"amiss": amiss[name]}
        if not runs:
            print(f"{name}: {report[name]}", file=sys.stderr)
            continue
        late_s, read_s, write_s = np.concatenate(runs).T
        quantities = {"wake_up_us": late_s, "read_us": read_s, "io_us": read_s + write_s}
        report[name] |= {quantity: spread_us(one) for quantity, one in quantities.items()}
        print(f"{name}: {report[name]}", file=sys.stderr)
    return report


def spread_us(seconds: np.ndarray) -> dict[str, float]:
    p50, p99 = np.percentile(seconds * 1e6, (50, 99)).round(2).tolist()
    return {"p50": p50, "p99": p99}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--against", type=Path, help="root of another checkout, run beside this")
    parser.add_argument("--deaths-only", action="store_true", help="no undisturbed runs")
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no case later")
    given = parser.parse_args()
    until_s = time.monotonic() + 60.0 * given.minutes
    rounds = given.rounds
    roots = [ROOT, *([given.against.resolve()] if given.against else [])]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with benches(folder) as rigs:
            both, timed = rigs[:2], rigs[2]
            report = {
                "ticks": {} if given.deaths_only else ticks(both, timed, folder, rounds),
                "deaths": deaths(both, folder, rounds, roots, until_s),
                "load": os.getloadavg(),
            }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
