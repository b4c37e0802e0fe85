"""What a user waits for: the time from the command to the first tick, and runs without a clock.

    python scripts/bench_run.py --rounds 5 > run.json

JSON on stdout, a table on stderr. Start-up is the real time from before the process starts to the
sample of the first tick. The speed of `--fast` comes from the difference between a long and a
short run: start-up and homing do not count. A run that ended early, as on a machine that starves
it, is counted and named under `amiss`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from pamctl.log.reader import read

DEVICE = ("--set", f"rig.sim.device=bench{os.getpid()}")
LONG_S, SHORT_S = 40.0, 20.0


class Amiss(Exception):
    """A run ended early; the message says why."""


def run(folder: Path, name: str, *options: str) -> tuple[float, Path]:
    """Run with law and log; return the wall seconds of the whole process, and the log.

    Raises `Amiss`.
    """
    path = folder / name
    command = [sys.executable, "-m", "pamctl", "run", "--quiet", "--log", str(path)]
    before_s = time.perf_counter()
    done = subprocess.run([*command, *options], check=False, capture_output=True, text=True)
    if done.returncode:
        raise Amiss(f"exit code {done.returncode}: {done.stderr.strip()}")
    return time.perf_counter() - before_s, path


def start_up_s(folder: Path, name: str) -> float:
    """Time from the command to the first tick."""
    started_ns = time.time_ns()
    _, path = run(folder, name, "--duration", "0.1", "--set", "rig.homing.enabled=false", *DEVICE)
    return float(read(path).time_ns[0] - started_ns) * 1e-9


def fast_multiple(folder: Path, name: str) -> float:
    """Simulated seconds per wall second, without start-up."""
    options = ("--fast", "--experiment", "tracking-1")
    long_s, _ = run(folder, f"long-{name}", *options, "--duration", str(LONG_S))
    short_s, _ = run(folder, f"short-{name}", *options, "--duration", str(SHORT_S))
    return (LONG_S - SHORT_S) / (long_s - short_s)


def repeat(
    measure: Callable[[Path, str], float], folder: Path, label: str, rounds: int
) -> dict[str, Any]:
    """Return the figures of all rounds, without those that went amiss."""
    figures: list[float] = []
    amiss: list[str] = []
    for index in range(rounds):
        try:
            figures.append(measure(folder, f"{label}-{index}.mcap"))
        except Amiss as reason:
            amiss.append(str(reason))
            print(f"{label}, round {index + 1}: {reason}", file=sys.stderr)
    return {"median": median(figures) if figures else None, "all": figures, "amiss": amiss}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        repeat(start_up_s, folder, "warm-caches", 1)
        report = {
            "start_up_s": repeat(start_up_s, folder, "start", rounds) | {"target": 2.0},
            "fast_multiple_of_real_time": repeat(fast_multiple, folder, "fast", rounds)
            | {"target": 40.0},
        }
    for name, figures in report.items():
        middle = "-" if figures["median"] is None else f"{figures['median']:.2f}"
        amiss = f", {len(figures['amiss'])} amiss" if figures["amiss"] else ""
        print(f"{name}: median {middle}, target {figures['target']}{amiss}", file=sys.stderr)
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
