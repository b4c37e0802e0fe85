"""What pamctl costs: one checkout, or several in turn on the same machine.

    python scripts/bench.py --only fast,replay --rounds 5 > bench.json
    python scripts/bench.py . ../other-checkout --rounds 3 > pair.json
    python scripts/bench.py --only cold          # from an empty home: with all compiling
    python scripts/bench.py --only wake_up,wake_up_under_hogs,drift
    python scripts/bench.py --only emergency_stop --rounds 5

Without `--only`: what the verbs cost. JSON on stdout, a table on stderr: the median over the rounds
and its spread. A measure has cases. A round calls each once, in turn, so that disturbances affect
all of them; ratios to the case named as the base, and between two checkouts, are those of
neighbouring calls. Compare only ratios within one run. A call that ended early, as on a machine
that starves a loop, is named under `failed`.

- The verbs: every call is a process of its own, run as a user types it, by the checkout's
  `.venv/bin/pamctl`. Processor seconds include all its descendants. Before each call ten million
  additions in a Python loop are timed: processors that others share are slower at times.
- `wake_up`: `GridClock` and `pamctl run` beside cyclictest (apt-get install rt-tests), each in a
  fresh process, since most real-time preparations cannot be undone. On a virtual machine the tail
  belongs to the hypervisor: `stalls_ms` is the time lost in wake-ups later than 0.2 ms,
  `queued_ms` the time that this kernel let the process wait for a CPU. A stall that was not queued
  happened below the kernel.
- `live_card`: the stand-in's registers are memory: `read` and `io` are the times of the nidaqmx
  package and of our code around it, not those of a card.
- `emergency_stop`: from before a client connects until the output is at the safe voltage.
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
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT), str(ROOT / "tests")]  # last: a worker takes pamctl of its checkout

from pamctl.log.reader import read  # noqa: E402

YARDSTICK = "total = 0\nfor number in range(10_000_000):\n    total += number"
PLANT = "effects:\n  valve_deadband: {fill_width_v: 0.25, exhaust_width_v: 0.2}\n"
LONG_S, SHORT_S, LIVE_S, LIVE_TRIM_S = 320.0, 20.0, 8.0, 1.0
"""Two runs of `--fast`, whose difference has no start-up; a run in real time, and its begin."""
IMPORTED_ROWS = 60_000
PERIOD_NS, DRIFT_TICKS = 1_000_000, 20_000
STALL_US = 200.0

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

    def work(self, worker: str) -> Any:
        """Return what a worker of this script finds, in a fresh process with this pamctl."""
        python = str(self.root / ".venv" / "bin" / "python")
        command = [python, __file__, "--worker", worker, "--seconds", str(self.given.seconds)]
        return json.loads(self.execute(command, self.environment(PYTHONPATH=str(self.root))).said)

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


# --- wake-up -------------------------------------------------------------------------------------


def measure_cyclictest(checkout: Checkout) -> Figures:
    """The kernel developers' own yardstick, in C. It holds /dev/cpu_dma_latency at 0 by itself."""
    ticks = round(checkout.given.seconds * 1e9 / PERIOD_NS)
    options = f"-q -p 99 -i {PERIOD_NS // 1000} -l {ticks} --histogram=50000"
    late_us: list[float] = []
    for line in run_cyclictest(options).splitlines():
        name, _, value = line.lstrip("# ").partition(":")
        if name == "Max Latencies":
            longest_us = float(value)
        elif name == "Histogram Overflows":
            late_us += [longest_us] * int(value)
        elif line.strip() and not line.startswith("#"):
            microsecond, count = map(int, line.split())  # spread evenly: nothing is rounded
            late_us += [microsecond + (i + 0.5) / count for i in range(count)]
    return summarise_lateness(np.array(late_us))


def run_cyclictest(options: str) -> str:
    """Return what cyclictest prints. Raises `CallFailed` without it."""
    program = shutil.which("cyclictest")
    if program is None:
        raise CallFailed("cyclictest is not on the PATH: apt-get install rt-tests")
    command = [program, "-m", *options.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise CallFailed(f"cyclictest failed (it needs root): {done.stderr.strip()}")
    return done.stdout


def summarise_lateness(late_us: NDArray[np.float64], queued_ms: float | None = None) -> Figures:
    """Quantiles behind the deadline, missed periods, and the time lost in stalls."""
    shares = {"p50_us": 50, "p99_us": 99, "p99.9_us": 99.9, "max_us": 100}
    figures = {
        name: float(np.percentile(late_us, share, method="inverted_cdf"))
        for name, share in shares.items()
    }
    return figures | {
        "missed": float(np.sum(late_us * 1e3 // PERIOD_NS)),
        "stalls_ms": float(late_us[late_us > STALL_US].sum() / 1e3),
        **({} if queued_ms is None else {"queued_ms": queued_ms}),
    }


def wait_on_grid(ticks: int, spin: bool, phase_ns: int | None = None) -> Figures:
    """Our clock, in a process prepared like the loop's."""
    from pamctl.realtime.clock import SPIN_NS, GridClock
    from pamctl.realtime.scheduling import prepare

    clock = GridClock(PERIOD_NS, phase_ns, SPIN_NS if spin else 0)
    with prepare("auto"):
        before_ms = queued_ms()
        wakes = [clock.wait() for _ in range(ticks)]
        queued = queued_ms() - before_ms
    # Lateness behind the deadline of each sleep, as in cyclictest: a sleep that ends periods
    # late is a missed tick for the loop, but a long latency here.
    late_ns = [wake.now_ns - wake.deadline_ns + wake.missed * PERIOD_NS for wake in wakes]
    return summarise_lateness(np.array(late_ns) / 1e3, queued)


def sleep_plainly(ticks: int) -> Figures:
    """The simplest way: time.sleep in an ordinary process."""
    late_us = []
    before_ms, deadline_ns = queued_ms(), time.monotonic_ns()
    for _ in range(ticks):
        deadline_ns += PERIOD_NS
        time.sleep(max(0, deadline_ns - time.monotonic_ns()) / 1e9)
        late_ns = time.monotonic_ns() - deadline_ns
        late_us.append(late_ns / 1e3)
        deadline_ns += late_ns // PERIOD_NS * PERIOD_NS
    return summarise_lateness(np.array(late_us), queued_ms() - before_ms)


def queued_ms() -> float:
    """Return how long this process has waited for a CPU so far."""
    _, waited_ns, _ = Path("/proc/self/schedstat").read_text().split()
    return int(waited_ns) / 1e6


def follow_grid(ticks: int) -> Figures:
    """Whether the grid follows the clock. Missed ticks are gaps in the index, not drift."""
    from pamctl.realtime.clock import SPIN_NS, GridClock
    from pamctl.realtime.scheduling import prepare

    with prepare("auto") as preparation:
        clock = GridClock(PERIOD_NS, spin_ns=SPIN_NS if preparation.may_spin else 0)
        first = last = clock.wait()
        missed = 0
        while last.tick < ticks:
            last = clock.wait()
            missed += last.missed
    on_grid_ns, elapsed_ns = last.tick * PERIOD_NS, last.now_ns - first.now_ns
    return {
        "missed": missed,
        "deadline_error_ns": last.deadline_ns - first.deadline_ns - on_grid_ns,
        "wake_drift_us": (elapsed_ns - on_grid_ns) / 1e3,
        "rate_error_ppm": (on_grid_ns / elapsed_ns - 1) * 1e6,
    }


def whole_loop(*options: str) -> Callable[[Checkout], Figures]:
    """Return the measure of `pamctl run` on the simulated rig: plant, tick, ring and recorder."""

    def measure(checkout: Checkout) -> Figures:
        length = ("--duration", str(checkout.given.seconds), "--set", "rig.homing.enabled=false")
        log = read(checkout.run("wake", *length, *options)[1])
        lateness = summarise_lateness(log["late_s"] * 1e6 + log["missed"] * PERIOD_NS / 1e3)
        return lateness | {"tick_p50_us": float(np.median(log["compute_s"]) * 1e6)}

    return measure


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
            hog.wait()


def under_hogs(measure: Callable[[Checkout], Figures]) -> Callable[[Checkout], Figures]:
    """Return the same measure beside processes that only compute."""

    def measure_under_hogs(checkout: Checkout) -> Figures:
        with cpu_hogs(checkout.given.hogs):
            return measure(checkout)

    return measure_under_hogs


def in_worker(worker: str) -> Callable[[Checkout], Figures]:
    """Return the measure of a worker."""
    return lambda checkout: checkout.work(worker)


WAKE_UPS: dict[str, Callable[[Checkout], Figures]] = {
    "cyclictest": measure_cyclictest,
    "grid": in_worker("grid"),
    "grid-spin": in_worker("grid-spin"),
    "grid-spin-phase0": in_worker("grid-spin-phase0"),
    "run": whole_loop("--set", "rig.loop.spin_us=0"),
    "run-spin": whole_loop(),
    "plain-sleep": in_worker("plain-sleep"),
}


WORKERS: dict[str, Callable[[int], Any]] = {
    "grid": lambda ticks: wait_on_grid(ticks, spin=False),
    "grid-spin": lambda ticks: wait_on_grid(ticks, spin=True),
    "grid-spin-phase0": lambda ticks: wait_on_grid(ticks, spin=True, phase_ns=0),
    "plain-sleep": sleep_plainly,
    "drift": lambda _: follow_grid(DRIFT_TICKS),
}
"""What runs in a fresh process, from the number of ticks."""


# --- the daemon ----------------------------------------------------------------------------------

AO_STEP_V = 20.0 / 65536.0
PATIENT = (
    "rig.limits.pressure_model_pa=2e6", "rig.limits.sample_age_s=60",
    "rig.limits.missed_ticks=1e6", "rig.limits.tracking_error_mm=20",
    "rig.loop.heartbeat_ms=5000", "rig.loop.starved_ms=20000", "rig.homing.enabled=false",
)  # fmt: skip
"""Limits that only a busy PC would pass are wide."""
PATIENCE_S = 60.0


class Daemon(NamedTuple):
    """A daemon on a simulated rig."""

    socket: Path
    device: str

    def ask(self, method: str, **params: Any) -> Any:
        """Ask as a verb does: connect, ask, disconnect."""
        from pamctl.daemon.client import Client

        with Client(self.socket) as client:
            return client.call(method, params)

    def wait_for(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the status when `holds` is true of it."""
        from pamctl.daemon.client import DaemonUnreachableError

        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            with suppress(DaemonUnreachableError):
                status: dict[str, Any] = self.ask("status")
                if holds(status):
                    return status
            time.sleep(0.02)
        raise CallFailed("the daemon does not reach the wanted state")

    def hold(self) -> Path:
        """Hold a position; return the log's path."""
        log = Path(self.ask("goto", position_m=8e-3, within_s=0.5)["log"])
        self.wait_for(lambda status: status["state"] == "ready" and bool(status["log"]))
        return log

    def is_safe(self) -> bool:
        """Tell whether the output is 0 V, the safe voltage."""
        from hal.sim import peek_v
        from pamctl.processes.backends import ao_path

        volts = peek_v(ao_path(self.device))
        return volts is not None and abs(volts) <= AO_STEP_V


@contextmanager
def hold_daemon(checkout: Checkout) -> Iterator[Daemon]:
    """Run a daemon of a checkout. A stall of the machine is measured, and does not end its run."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        folder = Path(temporary)
        daemon = Daemon(folder / "control.sock", f"sim-{folder.name}")
        command = [sys.executable, "-m", "pamctl", "daemon"]
        command += ["--rig", str(checkout.root / "config" / "rig" / "sim.yaml")]
        command += ["--socket", str(daemon.socket), "--logs", str(folder / "logs")]
        command += set_all([f"rig.sim.device={daemon.device}", *PATIENT])
        path = os.pathsep.join(filter(None, (str(checkout.root), os.environ.get("PYTHONPATH"))))
        said = subprocess.DEVNULL
        process = subprocess.Popen(
            command, env=os.environ | {"PYTHONPATH": path}, stdout=said, stderr=said
        )
        try:
            daemon.wait_for(lambda status: status["state"] == "idle")
            yield daemon
        finally:
            process.terminate()
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for left in Path("/dev/shm").glob(f"pamctl-{daemon.device}.*"):
                left.unlink()


def measure_emergency_stops(checkout: Checkout) -> Figures:
    """From before a client connects to the safe voltage, ms."""
    from pamctl.daemon.client import DaemonDeclinedError

    times_ms: list[float] = []
    with hold_daemon(checkout) as daemon:
        for _ in range(checkout.given.stops):
            with suppress(DaemonDeclinedError):  # a PC too busy to start a loop: nothing to stop
                times_ms.append(stop_at_once(daemon))
    if not times_ms:
        raise CallFailed("no loop started")
    return {"p50_ms": median(times_ms), "max_ms": max(times_ms)}


def stop_at_once(daemon: Daemon) -> float:
    """Return the time until the output is safe, ms."""
    daemon.hold()
    if daemon.is_safe():
        raise CallFailed("the output is already safe: there is nothing to measure")
    asking = threading.Thread(target=daemon.ask, args=("estop",))
    began_s = time.perf_counter()
    asking.start()
    while not daemon.is_safe():
        time.sleep(1e-4)
    took_ms = (time.perf_counter() - began_s) * 1e3
    asking.join()
    daemon.wait_for(lambda status: status["state"] == "fault" and not status["pids"])
    daemon.ask("ack")
    return took_ms


# --- what is measured ----------------------------------------------------------------------------


class Measure(NamedTuple):
    """Cases that are called in turn; a call gives the figures of its case."""

    calls: dict[str, Callable[[Checkout], Figures]]
    base: str = ""
    """The case whose figures of the same round the others are divided by."""


VERBS: dict[str, Callable[[Checkout], Figures]] = {
    "help": measure_help,
    "first_tick": measure_first_tick,
    "fast": measure_fast,
    "live": live(),
    "live_card": live_card(),
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
MEASURES: dict[str, Measure] = {name: Measure({"": measure}) for name, measure in VERBS.items()} | {
    "live_card_clocked": Measure({"": live_card(1000.0, "rig.nidaq.timing=hardware_timed")}),
    "wake_up": Measure(WAKE_UPS, "cyclictest"),
    "wake_up_under_hogs": Measure(
        {name: under_hogs(measure) for name, measure in WAKE_UPS.items()}, "cyclictest"
    ),
    "drift": Measure({"": in_worker("drift")}),
    "emergency_stop": Measure({"": measure_emergency_stops}),
}


class Target(NamedTuple):
    """An aim of the manual: which figure of which case, and how much it may or must be."""

    measure: str
    case: str
    figure: str
    of: str
    """`median`, `most`, or the median `ratio` to the base."""
    limit: float
    at_least: bool = False


TARGETS = [
    *(
        Target(f"wake_up{where}", f"{clock}{spin}", f"{share}_us", "ratio", limit)
        for where in ("", "_under_hogs")
        for spin, limits in (("", (1.2, 1.3)), ("-spin", (0.05, 0.1)))
        for clock in ("grid", "run")
        for share, limit in zip(("p50", "p99"), limits, strict=True)
    ),
    Target("fast", "", "times_real_time", "median", 500.0, at_least=True),
]


# --- rounds --------------------------------------------------------------------------------------


class Rounds(NamedTuple):
    """What the calls of one case and one checkout found, by round."""

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
) -> dict[str, dict[str, Rounds]]:
    """Return the rounds by case and checkout; the order changes each round.

    No call begins after `until_s` of the monotonic clock.
    """
    calls = {
        case: call for case, call in MEASURES[name].calls.items() if case in (given.cases or [case])
    }
    if name in VERBS and name != "cold":
        for checkout in checkouts.values():  # once without counting: libraries and logs are made
            with suppress(CallFailed):
                VERBS[name](checkout)
    found: dict[str, dict[str, Rounds]] = {}
    for index in range(given.rounds):
        first = index % max(1, len(calls))  # no case always follows the same neighbour
        for case in [*calls, *calls][first : first + len(calls)]:
            for which, checkout in list(checkouts.items())[:: 1 if index % 2 else -1]:
                if time.monotonic() > until_s:
                    return found
                additions_s, reason = time_additions(), ""
                figures: Figures | None = None
                try:
                    figures = calls[case](checkout)
                except CallFailed as failure:
                    reason = str(failure)
                rounds = found.setdefault(case, {}).setdefault(which, Rounds([], [], []))
                rounds.figures.append(figures)
                rounds.additions_s.append(additions_s)
                rounds.failed.extend([reason] if reason else [])
                label = " ".join(filter(None, (name, case, which)))
                said = reason or tell(figures or {})
                print(f"{label} round {index + 1}: {said}", file=sys.stderr, flush=True)
    return found


def summarise(found: dict[str, dict[str, Rounds]], base: str) -> dict[str, Any]:
    """Add medians and spread, and the ratios to the base and to the first of two checkouts."""
    report: dict[str, Any] = {}
    for case, by_checkout in found.items():
        report[case] = {
            which: rounds._asdict() | spread(rounds.figures)
            for which, rounds in by_checkout.items()
        }
        for which, rounds in by_checkout.items():
            if case != base and which in found.get(base, {}):
                ratios = divide(rounds.figures, found[base][which].figures)
                report[case][which]["ratio"] = spread(ratios) | {"rounds": ratios}
        if len(by_checkout) == 2:
            ratios = divide(*(rounds.figures for rounds in by_checkout.values()))
            report[case]["ratio"] = spread(ratios) | {"rounds": ratios}
    return report


def divide(some: Sequence[Figures | None], others: Sequence[Figures | None]) -> list[Figures]:
    """Return the ratios of the rounds that both have."""
    return [
        {key: one[key] / other[key] for key in one if other.get(key)}
        for one, other in zip(some, others, strict=False)
        if one and other
    ]


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


def format_report(report: dict[str, Any]) -> Iterator[str]:
    """Yield a line for each case of each checkout, its ratios, and the aims."""
    for name, cases in report.items():
        for case, by_checkout in cases.items():
            for which, found in by_checkout.items():
                label = f"{name}, {case}" if case else name
                yield f"{label:<32}{which}: {tell(found['median'], found)}"
                if found.get("failed"):
                    yield f"{'':32}{len(found['failed'])} failed: {found['failed'][-1]}"
                if "ratio" in found:
                    base = MEASURES[name].base
                    yield f"{'':32}over {base}: {tell(found['ratio']['median'], found['ratio'])}"
    for target in TARGETS:
        for which, found in report.get(target.measure, {}).get(target.case, {}).items():
            part = (
                found.get("ratio", {}).get("median") if target.of == "ratio" else found[target.of]
            )
            if which == "ratio" or not part or target.figure not in part:
                continue
            value = part[target.figure]
            is_met = value >= target.limit if target.at_least else value <= target.limit
            bound = "at least" if target.at_least else "at most"
            yield (
                f"  {target.measure}, {target.case}: {target.figure}, {target.of} {value:.3g}, "
                f"{bound} {target.limit:g}: {'met' if is_met else 'NOT MET'}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("checkouts", nargs="*", type=Path, default=[ROOT], help="with a .venv each")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", default=",".join(VERBS), help=f"of {','.join(MEASURES)}")
    parser.add_argument("--cases", nargs="+", metavar="NAME", help="only these cases")
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no call later")
    parser.add_argument("--hours", type=float, default=1.0, help="length of the long log")
    parser.add_argument("--seconds", type=float, default=2.0, help="length of each wake-up run")
    parser.add_argument("--hogs", type=int, default=3, help="processes that only compute")
    parser.add_argument("--stops", type=int, default=20, help="emergency stops a round")
    parser.add_argument("--worker", choices=WORKERS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        print(json.dumps(WORKERS[given.worker](round(given.seconds * 1e9 / PERIOD_NS))))
        return
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
            name: summarise(measure_in_turn(name, checkouts, given, until_s), MEASURES[name].base)
            for name in names
        }
    print(*format_report(report), sep="\n", file=sys.stderr)
    print(json.dumps(report | {"load": os.getloadavg()}, indent=1))


if __name__ == "__main__":
    main()
