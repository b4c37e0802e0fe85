"""What pamctl costs: one checkout, or several in turn on the same machine.

    python scripts/bench.py --only fast,replay --rounds 5 > bench.json
    python scripts/bench.py . ../other-checkout --rounds 3 > pair.json
    python scripts/bench.py --only cold          # from an empty home: with all compiling

JSON on stdout, a table on stderr: the median over the rounds and its spread. A round calls each
measure once for each checkout, in turn, so that disturbances affect both; the ratio between two
checkouts is that of neighbouring calls. Compare only ratios within one run. A call that ended
early, as on a machine that starves a loop, is named under `failed`.

Every call is a process of its own, run as a user types it, by the checkout's `.venv/bin/pamctl`.
Processor seconds include all its descendants. Before each call ten million additions in a Python
loop are timed: processors that others share are slower at times. Of `live_card` the stand-in's
registers are memory: `read` and `io` are the times of the nidaqmx package and of our code around
it, not those of a card.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT), str(ROOT / "tests")]

from pamctl.log.reader import read  # noqa: E402

YARDSTICK = "total = 0\nfor number in range(10_000_000):\n    total += number"
PLANT = "effects:\n  valve_deadband: {fill_width_v: 0.25, exhaust_width_v: 0.2}\n"
LONG_S, SHORT_S, LIVE_S, LIVE_TRIM_S = 320.0, 20.0, 8.0, 1.0
"""Two runs of `--fast`, whose difference has no start-up; a run in real time, and its begin."""
IMPORTED_ROWS = 60_000

Figures = dict[str, float]


class CallFailed(Exception):
    """A call ended with a wrong exit code, or too early; the message says what it printed."""


class Spent(NamedTuple):
    """What a call cost."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    said: str
    """Standard output."""


class Checkout:
    """One version of pamctl, with a home and a folder of its own."""

    def __init__(self, root: Path, folder: Path, given: argparse.Namespace) -> None:
        self.root, self.folder, self.given = root, folder, given
        self.home = folder / "home"
        self.home.mkdir(parents=True)
        self._made: dict[str, Path] = {}

    def environment(self, home: Path | None = None, **more: str) -> dict[str, str]:
        """Return an environment whose home is the checkout's, or the one given."""
        place = str(home or self.home)
        places = {"HOME": place, "XDG_CACHE_HOME": place, "XDG_RUNTIME_DIR": place}
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("PAMCTL", "PYTHONPATH"))}
        return kept | places | more

    def execute(
        self, command: Sequence[str], environment: dict[str, str], accept: int = 0
    ) -> Spent:
        """Run a program to its end. Raises `CallFailed` for an exit code but 0 and `accept`."""
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
            began_s = time.perf_counter()
            process = subprocess.Popen(
                command, cwd=self.folder, env=environment,
                stdin=subprocess.DEVNULL, stdout=out, stderr=errors,
            )  # fmt: skip
            _, status, used = os.wait4(process.pid, 0)
            wall_s = time.perf_counter() - began_s
            out.seek(0), errors.seek(0)
            said, complaint = out.read().decode(), errors.read().decode()
        if (code := os.waitstatus_to_exitcode(status)) not in (0, accept):
            raise CallFailed(f"{' '.join(command[1:4])}: exit code {code}: {complaint[-300:]}")
        return Spent(wall_s, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, said)

    def call(
        self, *arguments: str, home: Path | None = None, accept: int = 0, **more: str
    ) -> Spent:
        """Run `pamctl` to its end."""
        command = [str(self.root / ".venv" / "bin" / "pamctl"), *arguments]
        return self.execute(command, self.environment(home, **more), accept)

    def run(self, name: str, *options: str, **given: Any) -> tuple[Spent, Path]:
        """Run with law and log; return the cost and the log."""
        log = self.folder / f"{name}.mcap"
        log.unlink(missing_ok=True)
        device = ("--set", f"rig.sim.device=bench{os.getpid()}")
        backend = () if "--backend" in options else device
        return self.call("run", "--quiet", "--log", str(log), *backend, *options, **given), log

    def make(self, name: str, make: Callable[[], Path]) -> Path:
        """Return what `make` makes; it is made once."""
        if name not in self._made:
            self._made[name] = make()
        return self._made[name]

    def long_log(self) -> Path:
        """Return the log of a long run of experiment 2 without a clock."""
        seconds = 3600.0 * self.given.hours
        cycles = f"experiment.cycles={math.ceil(seconds / 10.0) + 1}"
        options = ("--fast", "--duration", f"{seconds:g}", "--set", cycles)
        return self.make("long", lambda: self.run("long", *options)[1])

    def diagnosed_logs(self) -> list[Path]:
        """Return the two runs of the README's diagnosis: a valve with a dead band."""
        plant = self.folder / "mine.yaml"
        plant.write_text(PLANT)
        options = ("--experiment", "diagnosis", "--fast", "--plant", str(plant))
        return [
            self.make(
                f"run-{seed}",
                lambda seed=seed: self.run(
                    f"run-{seed}", *options, "--seed", seed, "--set", f"experiment.seed={seed}"
                )[1],
            )
            for seed in "12"
        ]


# --- the verbs -----------------------------------------------------------------------------------


def cost(spent: Spent, *, with_memory: bool = False) -> Figures:
    """Return the cost of a call."""
    figures = {"wall_s": spent.wall_s, "cpu_s": spent.cpu_s}
    return figures | ({"peak_mb": spent.peak_mb} if with_memory else {})


def measure_help(checkout: Checkout) -> Figures:
    """`pamctl --help`: what every call pays."""
    return cost(checkout.call("--help"))


def measure_first_tick(checkout: Checkout) -> Figures:
    """Time from before the process starts to the sample of the first tick."""
    began_ns = time.time_ns()
    _, log = checkout.run("first", "--duration", "0.1", "--set", "rig.homing.enabled=false")
    return {"first_tick_s": float(read(log).time_ns[0] - began_ns) * 1e-9}


def measure_fast(checkout: Checkout) -> Figures:
    """Simulated seconds per second, without start-up and homing."""
    cycles = ("--set", f"experiment.cycles={LONG_S / 30.0 + 1:.0f}")
    options = ("--fast", "--experiment", "tracking-1", *cycles)
    long = checkout.run("fast", *options, "--duration", str(LONG_S))[0]
    short = checkout.run("fast", *options, "--duration", str(SHORT_S))[0]
    simulated_s = LONG_S - SHORT_S
    return {
        "times_real_time": simulated_s / (long.wall_s - short.wall_s),
        "times_processor_time": simulated_s / (long.cpu_s - short.cpu_s),
    }


def live(rate_hz: float = 1000.0) -> Callable[[Checkout], Figures]:
    """Return the measure of the tick of a run in real time over the simulated rig."""
    return lambda checkout: summarise_ticks(checkout.run("live", *live_options(rate_hz))[1])


def live_card(rate_hz: float = 1000.0, *more: str) -> Callable[[Checkout], Figures]:
    """Return the measure of the tick of a run in real time over the stand-in card."""

    def measure(checkout: Checkout) -> Figures:
        from standin.standin import Card, here

        here()  # for the compiler
        with tempfile.TemporaryDirectory() as folder:
            card = Card(Path(folder) / "registers", f"Dev{os.getpid()}b")
            sets = (f"rig.nidaq.device={card.name}", "rig.safe_volts=0.625", *more)
            rig = ("--backend", "nidaq", *set_all(sets), *live_options(rate_hz))
            return summarise_ticks(checkout.run("card", *rig, **card.environment())[1])

    return measure


def live_options(rate_hz: float) -> tuple[str, ...]:
    """Return a short tracking run at this rate."""
    rate = (f"rig.loop.rate_hz={rate_hz:g}", "rig.homing.enabled=false")
    spin = ("rig.loop.spin_us=50",) if rate_hz > 1000.0 else ()
    return ("--duration", str(LIVE_S), *set_all((*rate, *spin)))


def set_all(settings: Sequence[str]) -> list[str]:
    """Return settings as options."""
    return [part for setting in settings for part in ("--set", setting)]


def summarise_ticks(path: Path) -> Figures:
    """Percentiles of a live run's durations (us), and the share of its ticks that were missed."""
    log = read(path)
    settled = log.t > LIVE_TRIM_S
    late, compute, reading, writing = (
        log[name][settled] * 1e6 for name in ("late_s", "compute_s", "read_s", "write_s")
    )
    parts = {
        "sample_to_command": compute, "read_tick_write": reading + compute + writing, "late": late,
        "read": reading, "io": reading + writing,
    }  # fmt: skip
    figures = {
        f"{name}_p{share}_us": float(np.percentile(part, share))
        for name, part in parts.items()
        for share in (50, 99)
    }
    return figures | {"missed_percent": 100.0 * float(np.mean(log["missed"][settled]))}


def on_long_log(*verb: str) -> Callable[[Checkout], Figures]:
    """Return the measure of a verb that reads a long log: time and memory."""

    def measure(checkout: Checkout) -> Figures:
        return cost(checkout.call(*verb, str(checkout.long_log())), with_memory=True)

    return measure


def measure_recover(checkout: Checkout) -> Figures:
    """`log recover` of a long log whose end is cut off."""
    whole = checkout.long_log()
    cut, saved = checkout.folder / "cut.mcap", checkout.folder / "saved.mcap"
    shutil.copyfile(whole, cut)
    os.truncate(cut, whole.stat().st_size - 20_000)
    saved.unlink(missing_ok=True)
    spent = checkout.call("log", "recover", str(cut), str(saved), accept=3)
    return cost(spent, with_memory=True)


def measure_import(checkout: Checkout) -> Figures:
    """Import of measured text at 1 kHz."""
    source = checkout.folder / "rows.csv"
    t_s = 1e-3 * np.arange(IMPORTED_ROWS)
    chance = np.random.default_rng(1)
    pressure = 200.0 + 50.0 * np.sin(t_s) + chance.normal(0.0, 0.3, len(t_s))
    columns = np.column_stack((t_s, np.sin(2.0 * t_s), pressure, 12.0 + 4.0 * np.sin(t_s)))
    header = "Time [s],Valve command [V],Pressure [kPa gauge],Position [mm]"
    np.savetxt(source, columns, "%.5f", ",", header=header, comments="")
    imported = checkout.folder / "imported.mcap"
    imported.unlink(missing_ok=True)
    spent = checkout.call("log", "import", str(source), str(imported))
    return cost(spent, with_memory=True)


def measure_diagnosis(checkout: Checkout, home: Path | None = None) -> Figures:
    """The README's diagnosis, from two logs to the verdict."""
    train, holdout = map(str, checkout.diagnosed_logs())
    out = checkout.folder / "diagnosis"
    shutil.rmtree(out, ignore_errors=True)
    return cost(
        checkout.call("diagnose", train, "--holdout", holdout, "--out", str(out), home=home)
    )


def measure_cold(checkout: Checkout) -> Figures:
    """First and second call of the verbs of a first hour, beginning in an empty home."""
    logs = [str(log) for log in checkout.diagnosed_logs()]
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        calls: dict[str, Callable[[], float]] = {
            "run": lambda: checkout.run("cold", "--duration", "3", home=home)[0].cpu_s,
            "fast": lambda: checkout.run("cold", "--fast", home=home)[0].cpu_s,
            "replay": lambda: checkout.call("replay", logs[0], home=home).cpu_s,
            "compare": lambda: checkout.call("compare", logs[0], home=home).cpu_s,
            "diagnose": lambda: measure_diagnosis(checkout, home)["cpu_s"],
        }
        for name, call in calls.items():
            for which in ("first", "second"):
                figures[f"{name}_{which}_cpu_s"] = call()
    return figures | {"together_cpu_s": sum(figures.values())}


# --- what is measured ----------------------------------------------------------------------------


MEASURES: dict[str, Callable[[Checkout], Figures]] = {
    "help": measure_help,
    "first_tick": measure_first_tick,
    "fast": measure_fast,
    "live": live(),
    "live_card": live_card(),
    "live_card_clocked": live_card(1000.0, "rig.nidaq.timing=hardware_timed"),
    "live_10_khz": live(1e4),
    "live_card_10_khz": live_card(1e4),
    "log_info": on_long_log("log", "info"),
    "log_check": on_long_log("log", "check"),
    "log_recover": measure_recover,
    "replay": on_long_log("replay"),
    "compare": on_long_log("compare"),
    "import": measure_import,
    "diagnose": measure_diagnosis,
    "cold": measure_cold,
}


class Rounds(NamedTuple):
    """What the calls of one measure and one checkout found, by round."""

    figures: list[Figures | None]
    additions_s: list[float]
    failed: list[str]


def time_additions() -> float:
    """Return the processor seconds of ten million additions."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    exec(YARDSTICK, {})
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime - before


def measure_in_turn(
    name: str, checkouts: dict[str, Checkout], given: argparse.Namespace, until_s: float
) -> dict[str, Rounds]:
    """Return the rounds by checkout; which one is first changes each round.

    No call begins after `until_s` of the monotonic clock.
    """
    if name != "cold":
        for checkout in checkouts.values():  # once without counting: libraries and logs are made
            with suppress(CallFailed):
                MEASURES[name](checkout)
    found = {which: Rounds([], [], []) for which in checkouts}
    for index in range(given.rounds):
        for which, checkout in list(checkouts.items())[:: 1 if index % 2 else -1]:
            if time.monotonic() > until_s:
                return found
            figures: Figures | None = None
            found[which].additions_s.append(time_additions())
            try:
                figures = MEASURES[name](checkout)
                said = tell(figures)
            except CallFailed as failure:
                said = str(failure)
                found[which].failed.append(said)
            found[which].figures.append(figures)
            print(f"{name} {which} round {index + 1}: {said}", file=sys.stderr, flush=True)
    return found


def summarise(found: dict[str, Rounds]) -> dict[str, Any]:
    """Add medians and spread, and the ratio to the first of two checkouts."""
    report: dict[str, Any] = {
        which: rounds._asdict() | spread(rounds.figures) for which, rounds in found.items()
    }
    if len(found) == 2:
        ratios = [
            {key: one[key] / other[key] for key in one if other.get(key)}
            for one, other in zip(*(rounds.figures for rounds in found.values()), strict=False)
            if one and other
        ]
        report["ratio"] = spread(ratios) | {"rounds": ratios}
    return report


def spread(rounds: Sequence[Figures | None]) -> dict[str, Figures]:
    """Return the median of each figure, its least and its most."""
    values: dict[str, list[float]] = {}
    for figures in rounds:
        for key, value in (figures or {}).items():
            values.setdefault(key, []).append(value)
    how: dict[str, Callable[[list[float]], float]] = {"median": median, "least": min, "most": max}
    return {name: {key: pick(each) for key, each in values.items()} for name, pick in how.items()}


def tell(figures: Figures, found: dict[str, Figures] | None = None) -> str:
    """Return figures by name, as text; with what was found, also their spread."""
    cells = [f"{key} {value:.3g}" for key, value in figures.items()]
    if found:
        ends = [f" ({found['least'][key]:.3g} to {found['most'][key]:.3g})" for key in figures]
        cells = [cell + end for cell, end in zip(cells, ends, strict=True)]
    return ", ".join(cells) or "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("checkouts", nargs="*", type=Path, default=[ROOT], help="with a .venv each")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", default=",".join(MEASURES), help=f"of {','.join(MEASURES)}")
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no call later")
    parser.add_argument("--hours", type=float, default=1.0, help="length of the long log")
    given = parser.parse_args()
    names = given.only.split(",")
    if unknown := set(names) - set(MEASURES):
        parser.error(f"unknown: {', '.join(sorted(unknown))}")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # leaves no process behind
    until_s = time.monotonic() + 60.0 * given.minutes
    with tempfile.TemporaryDirectory() as temporary:
        checkouts = {
            str(root): Checkout(root.resolve(), Path(temporary, str(index)), given)
            for index, root in enumerate(given.checkouts)
        }
        report = {
            name: summarise(measure_in_turn(name, checkouts, given, until_s)) for name in names
        }
    for name, by_checkout in report.items():
        for which, found in by_checkout.items():
            print(f"{name:<20}{which}: {tell(found['median'], found)}", file=sys.stderr)
            if found.get("failed"):
                print(f"{'':20}failed: {', '.join(found['failed'])}", file=sys.stderr)
    print(json.dumps(report | {"load": os.getloadavg()}, indent=1))


if __name__ == "__main__":
    main()
