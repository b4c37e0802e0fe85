"""Wake-up lateness: `GridClock` and Debian's cyclictest, interleaved in one run.

    python scripts/bench_wakeup.py --rounds 6 --seconds 2 > wakeup.json

JSON on stdout, a table on stderr. Compare only ratios within one run, and only those of p50 and
p99: on a virtual machine the tail belongs to the hypervisor. See the last columns: `stalls` is the
time lost in wake-ups later than 0.2 ms, `queued` is the time that this kernel let the process wait
for a CPU. A stall that was not queued happened below the kernel.

A variant is a function from a number of ticks to a `Sample`, and an entry in `VARIANTS`. It runs in
a fresh process every round, because most real-time preparations of a process cannot be undone.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PERIOD_NS = 1_000_000
HISTOGRAM_US = 50_000
STALL_US = 200.0
BASELINE = "cyclictest"
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
TARGETS = {
    "grid": {"p50": 1.2, "p99": 1.3},
    "grid-spin": {"p50": 0.05, "p99": 0.1},
    "run": {"p50": 1.2, "p99": 1.3},
    "run-spin": {"p50": 0.05, "p99": 0.1},
}
"""Highest acceptable ratio to cyclictest."""

AMISS_CODE = 3
"""Exit code of a worker whose run ended early, as on a machine that starves it."""
INSTALL_CYCLICTEST = "cyclictest is not on the PATH: apt-get install rt-tests"


@dataclass
class Sample:
    """The result of one run of one variant."""

    lateness_us: list[float]
    """Lateness behind the deadline of each wake-up."""
    queued_ms: float | None = None
    """Total time that this kernel let us wait for a CPU, if the variant knows it."""
    notes: dict[str, str] = field(default_factory=dict)


Measure = Callable[[int], Sample]


# The variants.


def cyclictest(ticks: int) -> Sample:
    """The kernel developers' own yardstick, in C. It holds /dev/cpu_dma_latency at 0 by itself."""
    program = shutil.which("cyclictest")
    if program is None:
        raise SystemExit(INSTALL_CYCLICTEST)
    command = f"{program} -q -m -p 99 -i {PERIOD_NS // 1000} -l {ticks} --histogram={HISTOGRAM_US}"
    run = subprocess.run(command.split(), capture_output=True, text=True, check=False)
    if run.returncode:
        raise SystemExit(f"cyclictest failed (it needs root): {run.stderr.strip()}")
    return from_histogram(run.stdout)


def from_histogram(printed: str) -> Sample:
    """Times from counts per microsecond: spread evenly over each, so that nothing is rounded."""
    lateness_us: list[float] = []
    summary: dict[str, str] = {}
    for line in printed.splitlines():
        if line.startswith("#"):
            name, _, value = line.lstrip("# ").partition(":")
            summary[name] = value.strip()
        elif line.strip():
            microsecond, count = map(int, line.split())
            lateness_us += [microsecond + (i + 0.5) / count for i in range(count)]
    overflows = int(summary["Histogram Overflows"])
    lateness_us += [float(summary["Max Latencies"])] * overflows
    return Sample(lateness_us, notes={"overflows": str(overflows)})


def grid(spin_ns: int = 0, phase_ns: int | None = None) -> Measure:
    """Our clock, in a process prepared like the loop's."""

    def measure(ticks: int) -> Sample:
        from pamctl.realtime.clock import GridClock
        from pamctl.realtime.scheduling import prepare

        clock = GridClock(PERIOD_NS, phase_ns, spin_ns)
        with prepare("auto") as preparation:
            before_ms = queued_ms()
            wakes = [clock.wait() for _ in range(ticks)]
            queued = queued_ms() - before_ms
        # Lateness behind the deadline of each sleep, as in cyclictest: a sleep that ends periods
        # late is a missed tick for the loop, but a long latency here.
        lateness_us = [
            (wake.now_ns - wake.deadline_ns + wake.missed * PERIOD_NS) / 1e3 for wake in wakes
        ]
        return Sample(lateness_us, queued, preparation.as_metadata())

    return measure


def plain_sleep(ticks: int) -> Sample:
    """The simplest way: time.sleep in an ordinary process."""
    lateness_us = []
    before_ms = queued_ms()
    deadline_ns = time.monotonic_ns()
    for _ in range(ticks):
        deadline_ns += PERIOD_NS
        time.sleep(max(0, deadline_ns - time.monotonic_ns()) / 1e9)
        late_ns = time.monotonic_ns() - deadline_ns
        lateness_us.append(late_ns / 1e3)
        deadline_ns += late_ns // PERIOD_NS * PERIOD_NS
    return Sample(lateness_us, queued_ms() - before_ms)


def queued_ms() -> float:
    """How long this process has waited for a CPU so far."""
    _, waited_ns, _ = Path("/proc/self/schedstat").read_text().split()
    return int(waited_ns) / 1e6


def whole_loop(*options: str) -> Measure:
    """The loop of `pamctl run` on the simulated rig, with plant, tick, ring and recorder."""

    def measure(ticks: int) -> Sample:
        import numpy as np

        from pamctl.log.reader import read

        with tempfile.TemporaryDirectory() as folder:
            log_path = Path(folder) / "run.mcap"
            command = [sys.executable, "-m", "pamctl", "run", "--quiet", "--json"]
            wanted = ["--duration", str(ticks * PERIOD_NS / 1e9), "--log", str(log_path)]
            done = subprocess.run(
                [*command, *wanted, "--set", "rig.homing.enabled=false", *options],
                capture_output=True,
                text=True,
                check=False,
            )
            if done.returncode:
                tell(done.stderr.strip())
                sys.exit(AMISS_CODE)
            log = read(log_path)
        late_us = log["late_s"] * 1e6 + log["missed"] * PERIOD_NS / 1e3
        tick_us = np.percentile(log["compute_s"] * 1e6, (50, 99))
        work_us = (log["read_s"] + log["compute_s"] + log["write_s"]) * 1e6
        work_us = np.percentile(work_us, (50, 99))
        notes = {
            "tick_us_p50_p99": "{:.1f} {:.1f}".format(*tick_us),
            "read_tick_write_us_p50_p99": "{:.1f} {:.1f}".format(*work_us),
        }
        return Sample(late_us.tolist(), notes=notes)

    return measure


def spin_ns() -> int:
    """The clock's own default, imported late: only workers have pamctl on their path."""
    from pamctl.realtime.clock import SPIN_NS

    return SPIN_NS


VARIANTS: dict[str, Measure] = {
    BASELINE: cyclictest,
    "grid": grid(),
    "grid-spin": lambda ticks: grid(spin_ns())(ticks),
    "grid-spin-phase0": lambda ticks: grid(spin_ns(), phase_ns=0)(ticks),
    "run": whole_loop("--set", "rig.loop.spin_us=0"),
    "run-spin": whole_loop(),
    "plain-sleep": plain_sleep,
}


# Running them, each in a fresh process.


def run_fresh(variant: str, ticks: int) -> Sample:
    """Run one variant in a separate process."""
    return Sample(**run_worker("--worker", variant, "--ticks", str(ticks)))


class Amiss(Exception):
    """A run ended early."""


def run_worker(*arguments: str) -> Any:
    """Return what this script prints with these arguments; raises `Amiss`."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    run = subprocess.run(
        [sys.executable, __file__, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": path},
    )
    if run.returncode == AMISS_CODE:
        raise Amiss(" ".join(arguments))
    if run.returncode:
        raise SystemExit(run.returncode)
    return json.loads(run.stdout)


@contextmanager
def cpu_hogs(count: int) -> Iterator[None]:
    """Ordinary processes that only compute; they end by themselves with this process."""
    busy = f"import os\nwhile os.getppid() == {os.getpid()}:\n for _ in range(10**5): pass"
    hogs = [subprocess.Popen([sys.executable, "-c", busy]) for _ in range(count)]
    try:
        yield
    finally:
        for hog in hogs:
            hog.kill()
        for hog in hogs:
            hog.wait()


def measure_round_robin(
    variants: Sequence[str], rounds: int, ticks: int, label: str
) -> dict[str, list[Sample | None]]:
    """Run every variant once a round, so that disturbances affect all of them.

    None stands for a run that ended early.
    """
    samples: dict[str, list[Sample | None]] = {variant: [] for variant in variants}
    for number in range(rounds):
        tell(f"{label}: round {number + 1} of {rounds}")
        first = number % len(variants)  # rotated: no variant always follows the same neighbour
        for variant in (*variants[first:], *variants[:first]):
            try:
                samples[variant].append(run_fresh(variant, ticks))
            except Amiss:
                tell(f"{label}: round {number + 1}: {variant} ended early")
                samples[variant].append(None)
    return samples


def cpu_seconds() -> tuple[float, float]:
    """CPU time of all CPUs so far: in total, and stolen by the hypervisor."""
    first_line, _, _ = Path("/proc/stat").read_text().partition("\n")
    jiffies = [int(word) for word in first_line.split()[1:9]]
    per_second = os.sysconf("SC_CLK_TCK")
    return sum(jiffies) / per_second, jiffies[7] / per_second


def measure_drift(ticks: int) -> dict[str, float]:
    """Check that the grid follows the clock. Missed ticks are gaps in the index, not drift."""
    from pamctl.realtime.clock import GridClock
    from pamctl.realtime.scheduling import prepare

    with prepare("auto") as preparation:
        clock = GridClock(PERIOD_NS, spin_ns=spin_ns() if preparation.may_spin else 0)
        first = last = clock.wait()
        missed = 0
        while last.tick < ticks:
            last = clock.wait()
            missed += last.missed
    elapsed_ns = last.now_ns - first.now_ns
    on_grid_ns = last.tick * PERIOD_NS
    return {
        "seconds": elapsed_ns / 1e9,
        "ticks": last.tick + 1 - missed,
        "missed": missed,
        "deadline_error_ns": last.deadline_ns - first.deadline_ns - on_grid_ns,
        "wake_drift_us": (elapsed_ns - on_grid_ns) / 1e3,
        "rate_error_ppm": (on_grid_ns / elapsed_ns - 1) * 1e6,
    }


# Numbers out of samples.


def quantile(ascending: Sequence[float], share: float) -> float:
    """The smallest value that is not exceeded by this share of all values."""
    return ascending[max(0, -int(-share * len(ascending) // 1) - 1)]


def quantiles_us(lateness_us: Sequence[float]) -> dict[str, float]:
    """p50 to max."""
    ascending = sorted(lateness_us)
    return {name: round(quantile(ascending, share), 3) for name, share in QUANTILES.items()}


def summarise(rounds: dict[str, list[Sample | None]]) -> dict[str, Any]:
    """Each variant over all rounds, its ratio to the baseline, and the ratios by round.

    A variant none of whose runs came to its end is left out.
    """
    ended = {variant: [run for run in runs if run] for variant, runs in rounds.items()}
    samples = {variant: runs for variant, runs in ended.items() if runs}
    pooled = {variant: quantiles_us(pool(runs)) for variant, runs in samples.items()}
    by_round = {
        variant: [quantiles_us(run.lateness_us) if run else None for run in rounds[variant]]
        for variant in samples
    }
    return {
        variant: {
            "lateness_us": pooled[variant],
            "ratio": ratio(pooled[variant], pooled[BASELINE]),
            "ratio_median_of_rounds": {
                name: round(median(row[name] for row in rows), 4)
                for rows in [
                    [
                        ratio(ours, theirs)
                        for ours, theirs in zip(by_round[variant], by_round[BASELINE], strict=True)
                        if ours and theirs
                    ]
                ]
                for name in QUANTILES
            },
            "ended_early": len(rounds[variant]) - len(runs),
            "samples": sum(len(run.lateness_us) for run in runs),
            "missed": sum(int(late_us * 1e3 / PERIOD_NS) for late_us in pool(runs)),
            "stalls_ms": round(sum(late for late in pool(runs) if late > STALL_US) / 1e3, 1),
            "queued_ms": total_queued_ms(runs),
            "notes": runs[-1].notes,
        }
        for variant, runs in samples.items()
    }


def pool(runs: Sequence[Sample]) -> list[float]:
    """All rounds of a variant together."""
    return [value for run in runs for value in run.lateness_us]


def total_queued_ms(runs: Sequence[Sample]) -> float | None:
    """Over all rounds, if the variant knows it."""
    known = [run.queued_ms for run in runs if run.queued_ms is not None]
    return round(sum(known), 1) if known else None


def ratio(ours: dict[str, float], theirs: dict[str, float]) -> dict[str, float]:
    """The ratio of each quantile."""
    return {name: round(ours[name] / theirs[name], 4) for name in ours}


def against_targets(condition: dict[str, Any]) -> list[dict[str, Any]]:
    """The targets and whether the median round meets them: a neighbour's burst hits one round."""
    return [
        {
            "variant": variant,
            "quantile": name,
            "ratio_median_of_rounds": condition[variant]["ratio_median_of_rounds"][name],
            "ratio_pooled": condition[variant]["ratio"][name],
            "target": target,
            "met": condition[variant]["ratio_median_of_rounds"][name] <= target,
        }
        for variant, targets in TARGETS.items()
        if variant in condition
        for name, target in targets.items()
    ]


# Output.


def tell(text: str) -> None:
    """Print progress and tables to stderr: stdout is the result."""
    print(text, file=sys.stderr, flush=True)


def tell_condition(label: str, condition: dict[str, Any]) -> None:
    """Print one table: times, and their ratio to cyclictest in brackets."""
    tell(f"\n{label}: us behind the deadline (ratio to {BASELINE})")
    columns = "".join(f"{name:>18}" for name in QUANTILES)
    tell(f"{'':18}{columns}{'missed':>8}{'stalls ms':>11}{'queued ms':>11}")
    for variant, result in condition.items():
        late_us, ratios = result["lateness_us"], result["ratio"]
        cells = (f"{late_us[name]:9.2f} ({ratios[name]:.3f})" for name in QUANTILES)
        queued = "-" if result["queued_ms"] is None else f"{result['queued_ms']:.1f}"
        tell(
            f"{variant:18}{''.join(f'{cell:>18}' for cell in cells)}"
            f"{result['missed']:8d}{result['stalls_ms']:11.1f}{queued:>11}"
        )
        if "tick_us_p50_p99" in result["notes"]:
            tell(f"{'':18}tick p50, p99 us: {result['notes']['tick_us_p50_p99']}")
    for row in against_targets(condition):
        verdict = "met" if row["met"] else "NOT MET"
        tell(
            f"  {row['variant']} {row['quantile']}: {row['ratio_median_of_rounds']:.3f}x in the "
            f"median round, {row['ratio_pooled']:.3f}x pooled, target {row['target']}x: {verdict}"
        )


def tell_drift(drift: dict[str, float]) -> None:
    """One line."""
    tell(
        f"\ngrid over {drift['seconds']:.1f} s: {drift['ticks']} ticks, {drift['missed']} missed; "
        f"deadlines off the grid by {drift['deadline_error_ns']} ns, "
        f"wake-ups by {drift['wake_drift_us']:.1f} us"
    )


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=6, help="rounds of all variants")
    parser.add_argument(
        "--seconds", type=float, default=2.0, help="seconds of each variant in a round"
    )
    parser.add_argument("--hogs", type=int, default=3, help="CPU hogs; 0: idle only")
    parser.add_argument(
        "--drift-seconds", type=float, default=20.0, help="seconds of the drift run; 0: none"
    )
    parser.add_argument(
        "--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="NAME"
    )
    parser.add_argument("--worker", choices=[*VARIANTS, "drift"], help=argparse.SUPPRESS)
    parser.add_argument("--ticks", type=int, help=argparse.SUPPRESS)
    return parser.parse_args()


def compare(options: argparse.Namespace) -> dict[str, Any]:
    """Run the whole comparison."""
    variants = [BASELINE, *(name for name in options.variants if name != BASELINE)]
    ticks = round(options.seconds * 1e9 / PERIOD_NS)
    report: dict[str, Any] = {
        "machine": {
            "kernel": f"{platform.release()} {platform.version()}",
            "cpus": os.cpu_count(),
            "python": platform.python_version(),
        },
        "period_us": PERIOD_NS / 1e3,
        "rounds": options.rounds,
        "ticks_a_round": ticks,
        "conditions": {},
    }
    for label, hogs in {"idle": 0, f"{options.hogs} hogs": options.hogs}.items():
        before_s, stolen_before_s = cpu_seconds()
        with cpu_hogs(hogs):
            samples = measure_round_robin(variants, options.rounds, ticks, label)
        after_s, stolen_after_s = cpu_seconds()
        condition = summarise(samples)
        report["conditions"][label] = {
            "stolen_share": round((stolen_after_s - stolen_before_s) / (after_s - before_s), 4),
            "variants": condition,
            "targets": against_targets(condition),
        }
        tell_condition(label, condition)
    if options.drift_seconds:
        drift_ticks = round(options.drift_seconds * 1e9 / PERIOD_NS)
        report["drift"] = run_worker("--worker", "drift", "--ticks", str(drift_ticks))
        tell_drift(report["drift"])
    return report


def main() -> None:
    """Measure, or run as the worker of a measurement."""
    options = arguments()
    if options.worker == "drift":
        print(json.dumps(measure_drift(options.ticks)))
    elif options.worker:
        print(json.dumps(asdict(VARIANTS[options.worker](options.ticks))))
    elif shutil.which("cyclictest") is None:
        raise SystemExit(INSTALL_CYCLICTEST)
    else:
        # A terminated benchmark must leave no CPU hogs behind: let `finally` run.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        print(json.dumps(compare(options), indent=1))


if __name__ == "__main__":
    main()
