"""What watching costs the loop, and how long an emergency stop takes.

    python scripts/bench_daemon.py --rounds 30 --browser > daemon.json

JSON on stdout, a table on stderr. One daemon holds a position, in turn unwatched and watched: five
clients ask for the status at 10 Hz, beside a viewer of the web page, which has a process of its
own; `--browser` opens the page in a headless Chromium as well. The onlookers live from the first
round to the last, and are stopped (SIGSTOP) while the loop is alone.

Wake-up lateness and tick duration come from the log. A cyclictest (apt-get install rt-tests) runs
beside both halves of a round, with a thread on each CPU and the lowest real-time priority, so it
never delays the loop. Where it wakes up later than 0.4 ms, the machine stood still: a slice of
0.2 s in which that happened is left out, with its neighbours, of both halves. Compare medians of
the ratios; a round with too few ticks left is not counted.

Then a client demands the emergency stop many times; measured from before it connects until the
output is at the safe voltage.
"""

from __future__ import annotations

import argparse
import http.client
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from hal.sim import peek_v
from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError
from pamctl.log import read
from pamctl.log.reader import Log
from pamctl.processes.backends import SHARED_MEMORY, ao_path

CLIENTS, CLIENT_HZ, PAGE_HZ = 5, 10.0, 10.0
SETTLE_S, WINDOW_S = 2.0, 4.0
SLICE_S, STALL_US, FEWEST_TICKS = 0.2, 400, 1000
AO_STEP_V = 20.0 / 65536.0
PATIENCE_S = 60.0
CASES = ("alone", "watched")


class Bench:
    """A daemon on a simulated rig, and its client."""

    def __init__(self, folder: Path, spin_us: float) -> None:
        self.device, self.socket = f"bench{os.getpid()}", folder / "control.sock"
        command = [sys.executable, "-m", "pamctl", "daemon", "--socket", str(self.socket)]
        command += ["--logs", str(folder / "logs"), "--set", "rig.homing.enabled=false"]
        # A shared machine stalls now and then: that is measured here, and must not end the run.
        busy = ["limits.sample_age_s=0.5", "limits.missed_ticks=500", "limits.tracking_error_mm=20"]
        busy += ["limits.pressure_model_pa=300000.0", "loop.heartbeat_ms=1000"]
        command += [part for key in busy for part in ("--set", f"rig.{key}")]
        command += ["--set", f"rig.sim.device={self.device}"]
        command += ["--set", f"rig.loop.spin_us={spin_us}"]
        self.process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        self.wait_for(lambda status: status["state"] == "idle")

    def ask(self, method: str, **params: Any) -> Any:
        """Ask as a verb does: connect, ask, disconnect."""
        with Client(self.socket) as client:
            return client.call(method, params)

    def wait_for(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the status when `holds` is true of it."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            with suppress(DaemonUnreachableError):
                status: dict[str, Any] = self.ask("status")
                if holds(status):
                    return status
            if time.monotonic() > deadline_s:
                raise SystemExit("the daemon does not reach the wanted state")
            time.sleep(0.02)

    def hold(self, position_m: float) -> Path:
        """Hold a position; return the log's path."""
        log = Path(self.ask("goto", position_m=position_m, within_s=0.5)["log"])
        self.wait_for(lambda status: status["state"] == "ready" and bool(status["log"]))
        return log

    def is_safe(self) -> bool:
        """Tell whether the output is 0 V, the safe voltage."""
        volts = peek_v(ao_path(self.device))
        return volts is not None and abs(volts) <= AO_STEP_V

    def close(self) -> None:
        """End the daemon, and remove its files."""
        self.process.terminate()
        self.process.wait(PATIENCE_S)
        for left in SHARED_MEMORY.glob(f"pamctl-{self.device}.*"):
            left.unlink()


class Onlookers:
    """Five clients and a web viewer; `seen` counts what each kind received."""

    def __init__(self, bench: Bench, folder: Path, *, with_browser: bool) -> None:
        self.seen = {"answers": 0, "pictures": 0}
        self._looks, self._ended = threading.Event(), threading.Event()
        self._looks.set()
        self._stack = ExitStack()
        start = [sys.executable, "-m", "pamctl"]
        web = [*start, "watch", "--web", "--port", "0", "--socket", str(bench.socket)]
        page = self._stack.enter_context(_process(web, stdout=subprocess.PIPE))
        assert page.stdout
        address = page.stdout.readline().decode().strip()
        web_port = int(address.rsplit(":", 1)[1].rstrip("/"))
        self._processes = [page]
        if with_browser:
            command = [find_browser(), "--headless", "--no-sandbox", "--disable-gpu"]
            command += ["--remote-debugging-port=0", "--window-size=1280,1400"]
            command += [f"--user-data-dir={folder / 'browser'}", address]
            self._processes.append(self._stack.enter_context(_process(command)))
        each = [(_poll, bench)] * CLIENTS + [(_view_page, web_port)]
        self._threads = [
            threading.Thread(target=look, args=(at, self._look_again, self.seen), daemon=True)
            for look, at in each
        ]
        for thread in self._threads:
            thread.start()

    def _look_again(self, seconds: float) -> bool:
        """Wait, and as long as the onlookers are stopped; return False at the end."""
        over = self._ended.wait(seconds)
        self._looks.wait()
        return not (over or self._ended.is_set())

    def look(self, looks: bool) -> None:
        """Go on, or stand still."""
        (self._looks.set if looks else self._looks.clear)()
        for process in self._processes:
            os.killpg(process.pid, signal.SIGCONT if looks else signal.SIGSTOP)

    def end(self) -> None:
        """End all."""
        self.look(True)
        self._ended.set()
        for thread in self._threads:
            thread.join(PATIENCE_S)
        self._stack.close()


def find_browser() -> str:
    """Return the path of Chromium."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if (path := shutil.which(name)) is not None:
            return path
    raise SystemExit("no Chromium for --browser: apt-get install chromium")


@contextmanager
def _process(command: list[str], **pipes: Any) -> Iterator[subprocess.Popen[bytes]]:
    quiet = {"stderr": subprocess.DEVNULL, "start_new_session": True}
    process = subprocess.Popen(command, **{**quiet, **pipes})
    try:
        yield process
    finally:
        process.terminate()
        process.communicate()


LookAgain = Callable[[float], bool]


def _poll(bench: Bench, look_again: LookAgain, seen: dict[str, int]) -> None:
    with Client(bench.socket) as client:
        while look_again(1.0 / CLIENT_HZ):
            client.call("status")
            seen["answers"] += 1


def _view_page(port: int, look_again: LookAgain, seen: dict[str, int]) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    server, look = "", 0
    while look_again(1.0 / PAGE_HZ):
        try:
            connection.request("GET", f"/news?server={server}&after={look}")
            news = json.loads(connection.getresponse().read())
            seen["pictures"] += news["look"] > look
            _view_scope(connection)
        except http.client.RemoteDisconnected:  # at the end, or idle while it stood still
            connection.close()
            continue
        server, look = news["server"], news["look"]
    connection.close()


def _view_scope(connection: http.client.HTTPConnection) -> None:
    """Ask for the newest two seconds as the page does; it asks half as often."""
    connection.request("GET", "/scope/state")
    held = json.loads(connection.getresponse().read())
    if held["last_tick"] > held["first_tick"]:
        fields = "tick,t_s,reference_m,position_m,error_m,valve_v"
        limits = f"first={max(0, held['last_tick'] - 2000)}&last={held['last_tick']}"
        connection.request("GET", f"/scope/ticks?log={held['log']}&{limits}&fields={fields}")
        connection.getresponse().read()


class Window(NamedTuple):
    """A measured interval."""

    first: int
    last: int
    """Ticks, both included."""
    stalled: frozenset[int]
    """Slices in or beside which the machine stood still."""
    machine_p99_us: float
    """Of cyclictest; NaN without it."""


def measure_window(bench: Bench) -> Window:
    """Let the loop run beside a cyclictest."""
    time.sleep(SETTLE_S)
    first = int(bench.ask("status")["tick"]["tick"])
    late_us = run_cyclictest()
    return Window(
        first,
        int(bench.ask("status")["tick"]["tick"]),
        find_stalled_slices(late_us),
        float(np.percentile(late_us[:, 1], 99)) if len(late_us) else math.nan,
    )


def run_cyclictest() -> np.ndarray:
    """Return time since the start (s) and lateness (us) of each of its wake-ups, shape (n, 2)."""
    program = shutil.which("cyclictest")
    if program is None:
        time.sleep(WINDOW_S)
        return np.empty((0, 2))
    options = f"-S -m -p 1 -i 1000 -d 0 -v -l {round(WINDOW_S * 1e3)}"
    done = subprocess.run([program, *options.split()], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"cyclictest failed (it needs root): {done.stderr.strip()}")
    samples = [line.split(":") for line in done.stdout.splitlines() if line.count(":") == 2]
    return np.array([(int(count) * 1e-3, float(late)) for _, count, late in samples])


def find_stalled_slices(late_us: np.ndarray) -> frozenset[int]:
    """Return the slices of a stall, and those beside it: the two clocks began at other times.

    A wake-up that is late by many periods is counted as one period: the slices up to its end
    follow from its lateness.
    """
    stalled: set[int] = set()
    for at_s, late in late_us[late_us[:, 1] > STALL_US] if len(late_us) else ():
        first, last = int(at_s / SLICE_S) - 1, int((at_s + late * 1e-6) / SLICE_S) + 1
        stalled.update(range(first, last + 1))
    return frozenset(stalled)


def looking_on(bench: Bench, rounds: int, folder: Path, *, with_browser: bool) -> dict[str, Any]:
    """Wake-up and tick, unwatched and watched, in turn within one log."""
    log_path = bench.hold(8e-3)
    windows: dict[str, list[Window]] = {case: [] for case in CASES}
    onlookers = Onlookers(bench, folder, with_browser=with_browser)
    try:
        time.sleep(SETTLE_S * 3)  # the browser starts
        for index in range(rounds):
            for case in CASES if index % 2 == 0 else CASES[::-1]:
                onlookers.look(case == "watched")
                windows[case].append(measure_window(bench))
            print(f"round {index + 1} of {rounds}", file=sys.stderr, flush=True)
    finally:
        onlookers.end()
    bench.ask("stop")
    bench.wait_for(lambda status: not status["log"])
    report: dict[str, Any] = {"rounds": rounds, "seconds_each": WINDOW_S}
    return report | {"received": onlookers.seen} | compare_windows(read(log_path), windows)


def compare_windows(log: Log, windows: dict[str, list[Window]]) -> dict[str, Any]:
    """Compare the quiet slices of both halves of each round."""
    rate_hz = 1.0 / float(np.median(np.diff(log["t_s"])))
    pairs = list(zip(windows["alone"], windows["watched"], strict=True))
    chosen: dict[str, list[np.ndarray]] = {case: [] for case in CASES}
    for pair in pairs:
        stalled = list(pair[0].stalled | pair[1].stalled)
        rows = [_choose_ticks(log["tick"], window, stalled, rate_hz) for window in pair]
        if min(int(each.sum()) for each in rows) >= FEWEST_TICKS:
            for case, each in zip(CASES, rows, strict=True):
                chosen[case].append(each)
    if not chosen["alone"]:
        raise SystemExit("the machine stood still in every round: measure when it is less busy")
    slices = WINDOW_S / SLICE_S
    report: dict[str, Any] = {
        "rounds_counted": len(chosen["alone"]),
        "stalled_share": {
            case: float(np.mean([len(one.stalled) / slices for one in windows[case]]))
            for case in CASES
        },
        "machine_p99_us": {
            case: float(np.median([one.machine_p99_us for one in windows[case]])) for case in CASES
        },
        "ratio": {},
    }
    for case in CASES:
        report[case] = {"missed_ticks": [int(log["missed"][rows].sum()) for rows in chosen[case]]}
    for name, column in (("wake_up_us", "late_s"), ("tick_us", "compute_s")):
        each = {case: _percentiles([log[column][rows] for rows in chosen[case]]) for case in CASES}
        for case in CASES:
            report[case][name] = _spread(each[case])
        # By round: a disturbance of the machine affects both halves of a round.
        report["ratio"][name] = _spread(each["watched"] / each["alone"])
    return report


def _choose_ticks(
    ticks: np.ndarray, window: Window, stalled: list[int], rate_hz: float
) -> np.ndarray:
    slices = np.floor((ticks - window.first) / rate_hz / SLICE_S)
    return (ticks >= window.first) & (ticks <= window.last) & ~np.isin(slices, stalled)


def _percentiles(rounds: list[np.ndarray]) -> np.ndarray:
    return np.array([np.percentile(one * 1e6, (50, 99)) for one in rounds])


def _spread(each: np.ndarray) -> dict[str, Any]:
    """Median, least and most of the rounds: a stall affects one of them."""
    return {
        p: {"median": float(np.median(n)), "least": float(n.min()), "most": float(n.max())}
        for p, n in zip(("p50", "p99"), each.T, strict=True)
    }


def emergency_stops(bench: Bench, count: int) -> dict[str, Any]:
    """From before a client connects to the safe voltage, ms."""
    times_ms: list[float] = []
    for _ in range(count):
        with suppress(DaemonDeclinedError):  # a PC too busy to start a loop: nothing was stopped
            times_ms.append(_emergency_stop_ms(bench))
    if not times_ms:
        return {"p50_ms": math.nan, "max_ms": math.nan, "all_ms": []}
    return {"p50_ms": median(times_ms), "max_ms": max(times_ms), "all_ms": times_ms}


def _emergency_stop_ms(bench: Bench) -> float:
    bench.hold(8e-3)
    if bench.is_safe():
        raise SystemExit("the output is already safe: there is nothing to measure")
    asking = threading.Thread(target=bench.ask, args=("estop",))
    began_s = time.perf_counter()
    asking.start()
    while not bench.is_safe():
        time.sleep(1e-4)
    took_ms = (time.perf_counter() - began_s) * 1e3
    asking.join()
    bench.wait_for(lambda status: status["state"] == "fault" and not status["pids"])
    bench.ask("ack")
    return took_ms


def table(report: dict[str, Any]) -> str:
    """Write the figures for people."""
    looked = report["looking_on"]
    lines = [f"{'us':<13}{'alone':>8}{'watched':>9}   ratio, round by round"]
    for name in ("wake_up_us", "tick_us"):
        for p in ("p50", "p99"):
            alone, watched, ratio = (looked[key][name][p] for key in ("alone", "watched", "ratio"))
            cells = f"{alone['median']:>8.2f}{watched['median']:>9.2f}{ratio['median']:>8.2f}x"
            spread = f"({ratio['least']:.2f} to {ratio['most']:.2f})"
            lines.append(f"{name[:-3]:<8} {p:<4}{cells} {spread}")
    thrown = (f"{case} {looked['stalled_share'][case]:.0%}" for case in CASES)
    lines.append(
        f"{looked['rounds_counted']} of {looked['rounds']} rounds; left out: {', '.join(thrown)}"
    )
    missed = (f"{case} {looked[case]['missed_ticks']}" for case in CASES)
    lines.append(f"missed ticks in each round: {', '.join(missed)}")
    stop = report["emergency_stop"]
    lines.append(
        f"emergency stop: {stop['p50_ms']:.1f} ms p50, {stop['max_ms']:.1f} ms max, "
        f"{len(stop['all_ms'])} times"
    )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--stops", type=int, default=20)
    parser.add_argument("--browser", action="store_true", help="open the page in a Chromium too")
    parser.add_argument("--spin-us", type=float, default=100.0, help="rig.loop.spin_us")
    options = parser.parse_args()
    # The last run may still be on its way into the index of the folder.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        bench = Bench(Path(temporary), options.spin_us)
        try:
            report = {
                "looking_on": looking_on(
                    bench, options.rounds, Path(temporary), with_browser=options.browser
                ),
                "emergency_stop": emergency_stops(bench, options.stops),
            }
        finally:
            bench.close()
    print(json.dumps(report, indent=1))
    print(table(report), file=sys.stderr)


if __name__ == "__main__":
    main()
