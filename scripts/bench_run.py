"""What a user waits for: the first tick, runs without a clock, and the tick within the loop.

    python scripts/bench_run.py --rounds 5 > run.json
    python scripts/bench_run.py --rounds 5 --against ../other-checkout > pair.json

JSON on stdout, a table on stderr. Start-up is the real time from before the process starts to the
sample of the first tick. The speed of `--fast` comes from the difference between a long and a
short run: start-up and homing do not count. `live` is a real-time run over the simulated rig and
over the stand-in card: from the sample to the command, and read, tick and write together (us, p50
and p99). A run that ended early, as on a machine that starves it, is counted and named under
`amiss`. With `--against` every run of this checkout has a neighbour of the other one.
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
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from pamctl.log.reader import read  # noqa: E402

DEVICE = ("--set", f"rig.sim.device=bench{os.getpid()}")
AT_ONCE = ("--set", "rig.homing.enabled=false")
LONG_S, SHORT_S, LIVE_S = 320.0, 20.0, 8.0
LIVE_TRIM_S = 1.0
"""Left out at the begin of a live run: the first ticks are not what a run consists of."""

Figure = float | dict[str, float]


class Amiss(Exception):
    """A run ended early; the message says why."""


class Checkout:
    """One version of pamctl, in its own folder of runs."""

    def __init__(self, root: Path, folder: Path) -> None:
        self._environment = {"PYTHONPATH": str(root)}
        self._folder = folder
        folder.mkdir()

    def run(self, name: str, *options: str, **environment: str) -> tuple[float, Path]:
        """Run with law and log; return the wall seconds of the whole process, and the log.

        Raises `Amiss`.
        """
        path = self._folder / name
        command = [sys.executable, "-m", "pamctl", "run", "--quiet", "--log", str(path)]
        before_s = time.perf_counter()
        done = subprocess.run(
            [*command, *options],
            check=False,
            capture_output=True,
            text=True,
            cwd=self._folder,
            env=os.environ | environment | self._environment,
        )
        if done.returncode:
            raise Amiss(f"exit code {done.returncode}: {done.stderr.strip()}")
        return time.perf_counter() - before_s, path


def start_up_s(checkout: Checkout, name: str) -> float:
    """Time from the command to the first tick."""
    started_ns = time.time_ns()
    _, path = checkout.run(name, "--duration", "0.1", *AT_ONCE, *DEVICE)
    return float(read(path).time_ns[0] - started_ns) * 1e-9


def fast_multiple(checkout: Checkout, name: str) -> float:
    """Simulated seconds per wall second, without start-up."""
    cycles = ("--set", f"experiment.cycles={LONG_S / 30.0 + 1:.0f}")
    options = ("--fast", "--experiment", "tracking-1", *cycles)
    long_s, _ = checkout.run(f"long-{name}", *options, "--duration", str(LONG_S))
    short_s, _ = checkout.run(f"short-{name}", *options, "--duration", str(SHORT_S))
    return (LONG_S - SHORT_S) / (long_s - short_s)


def live_sim(checkout: Checkout, name: str, rate_hz: float = 1000.0) -> dict[str, float]:
    """Durations of the tick over the simulated rig (us)."""
    return summarise(checkout.run(name, *live_options(rate_hz), *DEVICE)[1])


def live_card(checkout: Checkout, name: str, rate_hz: float = 1000.0) -> dict[str, float]:
    """Durations of the tick over the stand-in card (us)."""
    from standin.standin import Card, here

    here()  # for the compiler
    with tempfile.TemporaryDirectory() as folder:
        card = Card(Path(folder) / "registers", f"Dev{os.getpid()}b")
        options = ("--backend", "nidaq", "--set", f"rig.nidaq.device={card.name}")
        volts = ("--set", "rig.safe_volts=0.625")
        options = (*options, *volts, *live_options(rate_hz))
        return summarise(checkout.run(name, *options, **card.environment())[1])


def live_options(rate_hz: float) -> tuple[str, ...]:
    """Return a short tracking run at this rate."""
    rate = ("--set", f"rig.loop.rate_hz={rate_hz:g}")
    if rate_hz > 1000.0:
        rate = (*rate, "--set", "rig.loop.spin_us=50")
    return ("--duration", str(LIVE_S), *AT_ONCE, *rate)


def summarise(path: Path) -> dict[str, float]:
    """Percentiles of a live run's durations (us), and the share of its ticks that were missed."""
    log = read(path)
    settled = log.t > LIVE_TRIM_S
    compute_us, read_us, write_us = (
        log[name][settled] * 1e6 for name in ("compute_s", "read_s", "write_s")
    )
    parts = {
        "sample_to_command": compute_us,
        "read": read_us,
        "write": write_us,
        "read_tick_write": read_us + compute_us + write_us,
        "late": log["late_s"][settled] * 1e6,
    }
    figures = {
        f"{name}_p{share}": float(np.percentile(part, share))
        for name, part in parts.items()
        for share in (50, 99)
    }
    return figures | {"missed_percent": 100.0 * float(np.mean(log["missed"][settled]))}


MEASURES: dict[str, tuple[Callable[[Checkout, str], Figure], float | dict[str, float]]] = {
    "start_up_s": (start_up_s, 2.0),
    "fast_multiple_of_real_time": (fast_multiple, 500.0),
    "live_sim_us": (live_sim, {"sample_to_command_p50": 8.0, "sample_to_command_p99": 15.0}),
    "live_card_us": (live_card, {"sample_to_command_p50": 8.0, "sample_to_command_p99": 15.0}),
    "live_sim_10_khz_us": (partial(live_sim, rate_hz=1e4), {"missed_percent": 0.1}),
    "live_card_10_khz_us": (partial(live_card, rate_hz=1e4), {"missed_percent": 0.1}),
}
"""Each measure with its target."""


def repeat(
    label: str,
    measure: Callable[[Checkout, str], Figure],
    checkouts: dict[str, Checkout],
    rounds: int,
) -> dict[str, Any]:
    """Return the figures of all rounds by checkout, without those that went amiss."""
    figures: dict[str, list[Figure]] = {which: [] for which in checkouts}
    amiss: dict[str, list[str]] = {which: [] for which in checkouts}
    for index in range(rounds):
        turn = list(checkouts.items())
        for which, checkout in turn if index % 2 else turn[::-1]:
            try:
                figure = measure(checkout, f"{label}-{index}.mcap")
                figures[which].append(figure)
                print(f"{label} ({which}), round {index + 1}: {tell(figure)}", file=sys.stderr)
            except Amiss as reason:
                amiss[which].append(str(reason))
                print(f"{label}, {which}, round {index + 1}: {reason}", file=sys.stderr)
    return {
        which: {"median": middle_of(figures[which]), "all": figures[which], "amiss": amiss[which]}
        for which in checkouts
    }


def middle_of(figures: list[Any]) -> Figure | None:
    """Return the median, of each figure for itself."""
    if not figures:
        return None
    if isinstance(figures[0], dict):
        return {name: median(one[name] for one in figures) for name in figures[0]}
    return median(figures)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--against", type=Path, help="root of another checkout, run beside this")
    parser.add_argument("--only", action="append", choices=MEASURES, help="repeatable")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        checkouts = {"this": Checkout(ROOT, folder / "this")}
        if given.against:
            checkouts["against"] = Checkout(given.against.resolve(), folder / "against")
        repeat("warm-caches", start_up_s, checkouts, 1)
        report = {
            name: repeat(name, measure, checkouts, given.rounds) | {"target": target}
            for name, (measure, target) in MEASURES.items()
            if name in (given.only or MEASURES)
        }
    for name, result in report.items():
        for which in checkouts:
            print(f"{name} ({which}): {tell(result[which]['median'])}", file=sys.stderr)
        print(f"  target {tell(result['target'])}", file=sys.stderr)
    print(json.dumps(report, indent=1))


def tell(figure: Figure | None) -> str:
    """Return a figure, or several by name, as text."""
    if isinstance(figure, dict):
        return ", ".join(f"{name} {value:.2f}" for name, value in figure.items())
    return "-" if figure is None else f"{figure:.2f}"


if __name__ == "__main__":
    main()
