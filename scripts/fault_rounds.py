"""Kill and freeze every process of real runs at random moments, over simulation and stand-ins.

    python scripts/fault_rounds.py --rounds 20 --resume faults.jsonl > faults.json
    python scripts/fault_rounds.py --pairs --rounds 5 > pairs.json
    python scripts/fault_rounds.py --triples --rounds 1 --draw 60 > triples.json
    python scripts/fault_rounds.py --pairs --write    # and the table goes into the manual

JSON on stdout, a line for each round and a table on stderr; exit code 3 if anything went wrong.
Ctrl-C ends it with the results so far (130). With `--resume` each finished round is stored, and
stored rounds are not run again. A round is one real run in real time with one real signal, with
`--pairs` two of them, with `--triples` three, each within 30 ms of the one before. Triples leave
one of front, loop and guardian alive. The benches: `pamctl run` over the simulation, over the
stand-ins for NI's driver (on demand and hardware-timed) and for comedi (they need gcc), and a
daemon over the simulation, whose front is the daemon itself. A run over a card ends by itself where
the machine gives it no CPU; such a round is counted apart.

After a round, the output must be at the safe voltage, the log complete to the last tick before the
signal, the exit code as documented, nothing left behind, and the next start clean. Processes that
are still frozen when the valve is safe are continued, but not the recorder: nobody may need it.
The output is watched all the time, as with a voltmeter; its clock starts before the last signal is
sent.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import permutations
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from measured_table import format_table, write_measured
from resumable_study import read_results, store_result
from standin.standin import Card
from support.patience import PATIENCE_S, await_true
from support.processes.children import await_children, await_gone
from support.processes.rings import await_ring

from hal.sim import peek_v
from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError
from pamctl.log.reader import read
from pamctl.processes.backends import SHARED_MEMORY, ao_path
from pamctl.recording.ring import Ring

SAFE_V, AO_STEP_V = 0.625, 20.0 / 65536.0
"""A voltage that neither a reset nor a power-up leaves behind."""
PAMCTL = [sys.executable, "-m", "pamctl"]
OPTIONS = ["rig.homing.enabled=false", f"rig.safe_volts={SAFE_V}"]
BUSY_PC = ["rig.limits.sample_age_s=0.5", "rig.limits.missed_ticks=500"]
STILL = {"kind": "steps", "steps": [{"valve_v": 0.0, "hold_s": 600.0}]}
"""An experiment that holds the valve off its safe voltage."""
MOVING_TICKS = 300
STARVED = "the loop was starved"
"""The message of a run over a card that got no CPU and ended before its first fault."""

PROCESSES = {"loop": "loop_main", "guardian": "guardian_main", "recorder": "recorder"}
VALVE_KEEPERS = {"front", "loop", "guardian"}
"""Each of them can make the valve safe."""
SIGNALS = {"killed": signal.SIGKILL, "frozen": signal.SIGSTOP}
PAIR_WITHIN_S = 0.03
BENCHES = ("sim", "nidaq", "nidaq_hardware_timed", "comedi", "daemon")

Fault = tuple[str, str]
"""A process and what happens to it."""
FAULTS: list[Fault] = [(process, what) for process in (*PROCESSES, "front") for what in SIGNALS]


class Bench(NamedTuple):
    """A rig whose output can be looked at from outside."""

    name: str
    backend: str
    settings: list[str]
    environment: Mapping[str, str]
    output_v: Callable[[], float]


@contextmanager
def benches(folder: Path) -> Iterator[list[Bench]]:
    """Set up all rigs under names of their own, and clear away what bears those names."""
    name = f"rounds{os.getpid()}"
    card = Card(folder / "registers", f"{name}card")
    chosen = [*OPTIONS, *BUSY_PC, f"rig.nidaq.device={card.name}"]
    clocked = [*chosen, "rig.nidaq.timing=hardware_timed"]
    other = Card(folder / "comedi-registers", f"comedi{os.getpid()}")
    comedi = [*OPTIONS, *BUSY_PC, f"rig.comedi.device=/dev/{other.name}"]

    def simulated(name: str, device: str) -> Bench:
        settings = [*OPTIONS, f"rig.sim.device={device}"]
        return Bench(name, "sim", settings, os.environ, lambda: peek_v(ao_path(device)))

    try:
        yield [
            simulated("sim", name),
            Bench("nidaq", "nidaq", chosen, card.environment(), lambda: card.output_v),
            Bench(
                "nidaq_hardware_timed", "nidaq", clocked, card.environment(), lambda: card.output_v
            ),
            Bench("comedi", "comedi", comedi, other.environment(), lambda: other.output_v),
            simulated("daemon", f"{name}daemon"),
        ]
    finally:
        for pattern in (f"pamctl-{name}*", f"pamctl-{other.name}*"):
            for left in SHARED_MEMORY.glob(pattern):
                left.unlink()


class Run:
    """A real run of a bench."""

    def __init__(self, bench: Bench, log: Path, *arguments: str) -> None:
        self.bench, self.log = bench, log
        self.front = self._start("run", "--quiet", "--log", str(log), *arguments)

    def _start(self, verb: str, *arguments: str) -> subprocess.Popen[bytes]:
        sets = [word for setting in self.bench.settings for word in ("--set", setting)]
        return subprocess.Popen(
            [*PAMCTL, verb, "--backend", self.bench.backend, *sets, *arguments],
            env=self.bench.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )

    def stop(self) -> None:
        """End a run whose processes all live."""
        self.front.send_signal(signal.SIGINT)

    def expected_code(self, faults: Sequence[Fault]) -> int:
        """Return the documented exit code for this end."""
        if ("front", "killed") in faults:
            return -signal.SIGKILL
        return 130 if list(faults) == [("front", "frozen")] else 1

    def pids(self) -> dict[str, int]:
        """Return the process ids by name, once all are there."""
        parts = await_children(self.front.pid, *PROCESSES.values())
        return {"front": self.front.pid} | {name: parts[part] for name, part in PROCESSES.items()}

    def await_motion(self, ring: Ring) -> None:
        """Return at a random moment at which the valve is off its safe voltage."""
        deadline_s = time.monotonic() + PATIENCE_S
        while ring.head < MOVING_TICKS or self.bench.output_v() < SAFE_V + 1.0:
            if self.front.poll() is not None:
                assert self.front.stderr
                said = self.front.stderr.read().decode().strip()
                raise AssertionError(f"the run ended too early: {said}")
            require(time.monotonic() < deadline_s, f"only {ring.head} rows, the valve is still")
            time.sleep(0.01)
        time.sleep(random.uniform(0.0, 0.7))

    def await_safe(self, since_s: float) -> float:
        """Watch the output; return the time until it is safe, in ms."""
        while abs(self.bench.output_v() - SAFE_V) > AO_STEP_V:
            require(time.perf_counter() - since_s < PATIENCE_S, f"{self.bench.output_v()} V")
            time.sleep(1e-4)
        return (time.perf_counter() - since_s) * 1e3

    def await_end(self, pids: Mapping[str, int]) -> int:
        """Wait until no process of the run is left; return the exit code."""
        self.front.communicate(timeout=PATIENCE_S)
        await_gone(*pids.values())
        return self.front.returncode


class OrderedRun(Run):
    """A run that a daemon was asked for. The daemon is the front."""

    def __init__(self, bench: Bench, log: Path) -> None:
        self.bench = bench
        self._socket, logs = log.with_suffix(".sock"), log.with_suffix("")
        self.front = self._start("daemon", "--socket", str(self._socket), "--logs", str(logs))
        try:
            if self._ask("status")["fault"]:
                self._ask("ack")  # the fault of the round before
            self.log = Path(self._ask("start", name="rounds", experiment=STILL)["log"])
        except BaseException:
            self.front.kill()
            self.front.communicate()
            raise

    def _ask(self, method: str, **params: object) -> Any:
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                with Client(self._socket) as client:
                    return client.call(method, params)
            except DaemonDeclinedError as error:
                raise AssertionError(f"the daemon: {error}") from error
            except DaemonUnreachableError as error:
                require(time.monotonic() < deadline_s, f"the daemon: {error}")
                time.sleep(0.02)

    def stop(self) -> None:
        """Stop at once, which ends the session."""
        self._ask("estop")

    def await_end(self, pids: Mapping[str, int]) -> int:
        """End the daemon, if it lives, once it has ended its session by itself."""
        await_true(lambda: not self._has_session(), "the session goes on")
        self.front.terminate()
        return super().await_end(pids)

    def _has_session(self) -> bool:
        try:
            with Client(self._socket) as client:
                return bool(client.call("status", {})["pids"])
        except DaemonUnreachableError:
            return False  # it was killed

    def expected_code(self, faults: Sequence[Fault]) -> int:
        """A daemon outlives its session."""
        return -signal.SIGKILL if ("front", "killed") in faults else 0


def require(holds: bool, what: str) -> None:
    if not holds:
        raise AssertionError(what)


def round_of(bench: Bench, faults: Sequence[Fault], log: Path) -> dict[str, Any]:
    """Run once with these faults; return the time until safe (ms) and the ticks lost."""
    run = OrderedRun(bench, log) if bench.name == "daemon" else Run(bench, log)
    pids: dict[str, int] = {}
    try:
        pids = run.pids()
        with Ring.attach(path := await_ring(run.front.pid)) as ring:
            run.await_motion(ring)
            for index, (process, what) in enumerate(faults):
                time.sleep(random.uniform(0.0, PAIR_WITHIN_S) if index else 0.0)
                began_s = time.perf_counter()
                send(pids[process], SIGNALS[what])
            if list(faults) == [("front", "frozen")]:
                # A frozen front harms nobody: the run goes on, and can be ended.
                time.sleep(0.3)
                send(pids["front"], signal.SIGCONT)
                began_s = time.perf_counter()
                run.stop()
            took_ms = run.await_safe(began_s)
            tick = ring.latest_tick()
        for name in VALVE_KEEPERS:  # those that nobody had to kill go on, and end
            send(pids[name], signal.SIGCONT)
        code = run.await_end(pids)
        await_true(lambda: not path.exists(), "nobody has finished the log")
    finally:
        for pid in pids.values():
            send(pid, signal.SIGKILL)
        run.front.kill()
        run.front.communicate()
    require(code == run.expected_code(faults), f"exit code {code}")
    require(abs(bench.output_v() - SAFE_V) <= AO_STEP_V, f"{bench.output_v()} V after the end")
    next_start(bench, log.with_suffix(".next.mcap"))
    require(not list(SHARED_MEMORY.glob(f"pamctl-{run.front.pid}-*")), "a ring is left behind")
    assert tick is not None
    return {"safe_after_ms": took_ms, "ticks_lost": ticks_lost(run.log, int(tick["tick"]))}


def send(pid: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, number)


def ticks_lost(path: Path, last: int) -> int:
    """Check a log for gaps; return how many of the ticks put it lacks."""
    log = read(path)
    require(np.array_equal(np.diff(log["tick"]) - 1, log["missed"][1:]), "the log has gaps")
    outcomes = [event for event in log.events if event["event"] == "outcome"]
    require(len(outcomes) == 1, f"{len(outcomes)} outcomes in the log")
    return max(0, last - int(log["tick"][-1]))


def next_start(bench: Bench, log: Path) -> None:
    """Start once more; raise AssertionError unless all is well."""
    run = Run(bench, log, "--duration", "0.05")
    _, said = run.front.communicate(timeout=3 * PATIENCE_S)
    require(run.front.returncode == 0, f"the next start: {said.decode().strip()}")


def list_faults(hits: int) -> list[tuple[Fault, ...]]:
    """List every ordered choice of so many faults, each of another process.

    A fault leaves at least one process alive that can make the valve safe.
    """
    return [
        faults
        for faults in permutations(FAULTS, hits)
        if len(hit := {process for process, _ in faults}) == hits and not hit >= VALVE_KEEPERS
    ]


def rounds(
    count: int,
    done: Counter[str],
    hits: int = 1,
    names: Sequence[str] = BENCHES,
    drawn: int | None = None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Run all cases in turn, so that all see the same PC, without the rounds in `done`.

    With `drawn`, only so many cases, the same ones each time.
    """
    with tempfile.TemporaryDirectory() as temporary, benches(Path(temporary)) as rigs:
        cases = [
            (f"{bench.name} {', '.join(map(' '.join, faults))}", bench, faults)
            for bench in rigs
            for faults in list_faults(hits)
            if bench.name in names
        ]
        if drawn is not None:
            cases = random.Random(drawn).sample(cases, min(drawn, len(cases)))
        for index in range(count):
            for case, bench, faults in cases:
                if index < done[case]:
                    continue
                log = Path(temporary) / f"{case}-{index}.mcap".replace(" ", "-").replace(",", "")
                try:
                    found = round_of(bench, faults, log)
                except (AssertionError, OSError, subprocess.TimeoutExpired) as amiss:
                    found = {"starved" if STARVED in str(amiss) else "amiss": str(amiss)}
                yield case, found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--resume", type=Path, metavar="FILE", help="file that stores each round")
    many = parser.add_mutually_exclusive_group()
    many.add_argument("--pairs", action="store_const", const=2, dest="hits", help="two faults")
    many.add_argument("--triples", action="store_const", const=3, dest="hits", help="three faults")
    parser.add_argument("--benches", default=",".join(BENCHES), help="[default: %(default)s]")
    parser.add_argument("--draw", type=int, metavar="N", help="only N cases, drawn at random")
    parser.add_argument("--write", action="store_true", help="put the table into the manual")
    options = parser.parse_args()
    # What a shell starts in the background ignores Ctrl-C. Every run would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    names = options.benches.split(",")
    cases: dict[str, list[dict[str, Any]]] = {}
    for found in read_results(options.resume):
        cases.setdefault(found.pop("case"), []).append(found)
    done = Counter({case: len(found) for case, found in cases.items()})
    stopped = False
    try:
        for case, found in rounds(options.rounds, done, options.hits or 1, names, options.draw):
            cases.setdefault(case, []).append(found)
            print(
                f"{case:<40}{len(cases[case]):>4}  {describe_round(found)}",
                file=sys.stderr,
                flush=True,
            )
            store_result(options.resume, {"case": case, **found})
    except KeyboardInterrupt:
        stopped = True
    report = {case: summary(found) for case, found in cases.items()}
    tell(report)
    if options.write:
        write_measured("fault_rounds", format_cases(cases))
    print(json.dumps({"stopped": stopped, "cases": report}, indent=1))
    if stopped:
        return 130
    return 0 if all(row["rounds"] == row["well"] for row in report.values()) else 3


def describe_round(found: dict[str, Any]) -> str:
    if "safe_after_ms" not in found:
        return f"AMISS: {found['amiss']}" if "amiss" in found else found["starved"]
    return f"safe after {found['safe_after_ms']:.1f} ms, {found['ticks_lost']} ticks lost"


def tell(report: dict[str, dict[str, Any]]) -> None:
    """Print the table of all cases."""
    print(
        f"{'':<40}{'rounds':>7}{'correct':>12}{'lost':>6}{'p50 ms':>9}{'max ms':>9}",
        file=sys.stderr,
    )
    for case, row in report.items():
        print(
            f"{case:<40}{row['rounds']:>7}{row['well']:>12}{row['ticks_lost']:>6}"
            f"{row['safe_after_ms']['p50']:>9.1f}{row['safe_after_ms']['max']:>9.1f}",
            file=sys.stderr,
        )


def format_cases(cases: Mapping[str, list[dict[str, Any]]]) -> str:
    """Format a row for each choice of processes, a column for each bench."""
    rows: dict[tuple[str, ...], dict[str, list[dict[str, Any]]]] = {}
    for case, found in cases.items():
        bench, _, faults = case.partition(" ")
        hit = tuple(sorted(fault.split()[0] for fault in faults.split(", ")))
        rows.setdefault(hit, {}).setdefault(bench, []).extend(found)
    names = [name for name in BENCHES if any(name in row for row in rows.values())]
    return format_table(
        ["killed or frozen, in any order", *names],
        [
            [", ".join(hit), *(format_cell(row.get(name, [])) for name in names)]
            for hit, row in sorted(rows.items(), key=lambda item: (len(item[0]), item[0]))
        ],
    )


def format_cell(found: Sequence[dict[str, Any]]) -> str:
    """Say how many rounds went well, and how late the valve was safe at worst."""
    figures = summary(found)
    worst = f"{figures['safe_after_ms']['max']:.0f} ms" if figures["well"] else ""
    return f"{figures['well']} of {figures['rounds']}, {worst}" if found else ""


def summary(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of one case. Rounds that the machine starved are counted apart."""
    well = [one for one in found if "safe_after_ms" in one]
    times_ms = [one["safe_after_ms"] for one in well] or [float("nan")]
    return {
        "rounds": sum("starved" not in one for one in found),
        "starved": sum("starved" in one for one in found),
        "well": sum(one["ticks_lost"] == 0 for one in well),
        "amiss": [one["amiss"] for one in found if "amiss" in one],
        "ticks_lost": sum(one["ticks_lost"] for one in well),
        "safe_after_ms": {"p50": median(times_ms), "max": max(times_ms), "all": times_ms},
    }


if __name__ == "__main__":
    sys.exit(main())
