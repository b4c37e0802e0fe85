"""What watching costs the loop, and how long an emergency stop takes.

    python scripts/bench_daemon.py --rounds 6 > daemon.json

JSON on stdout, a table on stderr. One daemon holds a position, in turn unwatched and watched: five
clients ask for the status at 10 Hz, beside a viewer of the web page and a Foxglove client, each
served by its own process. Wake-up lateness and tick duration come from the log. Then a client
demands the emergency stop many times; measured from before it connects until the output is at
the safe voltage. Needs `pamctl[live]`.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from hal.sim.register import peek_v
from pamctl.daemon.client import Client, DaemonUnreachableError
from pamctl.log import read
from pamctl.processes.backends import SHARED_MEMORY, ao_path

CLIENTS, CLIENT_HZ, PAGE_HZ = 5, 10.0, 10.0
SETTLE_S, WINDOW_S = 2.0, 4.0
AO_STEP_V = 20.0 / 65536.0
PATIENCE_S = 60.0
CASES = ("alone", "watched")


class Bench:
    """A daemon on a simulated rig, and its client."""

    def __init__(self, folder: Path) -> None:
        self.device, self.socket = f"bench{os.getpid()}", folder / "control.sock"
        command = [sys.executable, "-m", "pamctl", "daemon", "--socket", str(self.socket)]
        command += ["--logs", str(folder / "logs"), "--set", "rig.homing.enabled=false"]
        # A shared machine stalls now and then: that is measured here, and must not end the run.
        busy = ["limits.sample_age_s=0.5", "limits.missed_ticks=500", "limits.tracking_error_mm=20"]
        busy += ["limits.pressure_model_pa=300000.0", "loop.heartbeat_ms=1000"]
        command += [part for key in busy for part in ("--set", f"rig.{key}")]
        command += ["--set", f"rig.sim.device={self.device}"]
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


@contextmanager
def onlookers(bench: Bench, seen: dict[str, int]) -> Iterator[None]:
    """Five clients, a web viewer, a Foxglove client; `seen` counts what each kind received."""
    ended = threading.Event()
    with ExitStack() as stack:
        start = [sys.executable, "-m"]
        web = [*start, "pamctl", "watch", "--web", "--port", "0", "--socket", str(bench.socket)]
        page = stack.enter_context(_process(web, stdout=subprocess.PIPE))
        assert page.stdout
        web_port = int(page.stdout.readline().decode().rsplit(":", 1)[1].strip().rstrip("/"))
        live = [*start, "pamctl.live.live_main", "0", "--socket", str(bench.socket)]
        viewer = stack.enter_context(_process(live, stdin=subprocess.PIPE, stderr=subprocess.PIPE))
        assert viewer.stderr
        live_port = int(viewer.stderr.readline().decode().split()[1].rsplit(":", 1)[1])
        threads = [
            threading.Thread(target=_poll, args=(bench, ended, seen)) for _ in range(CLIENTS)
        ]
        threads.append(threading.Thread(target=_view_page, args=(web_port, ended, seen)))
        threads.append(threading.Thread(target=_view_live, args=(live_port, ended, seen)))
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            ended.set()
            for thread in threads:
                thread.join()


@contextmanager
def _process(command: list[str], **pipes: Any) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, **{"stderr": subprocess.DEVNULL, **pipes})
    try:
        yield process
    finally:
        process.terminate()
        process.communicate()


def _poll(bench: Bench, ended: threading.Event, seen: dict[str, int]) -> None:
    with Client(bench.socket) as client:
        while not ended.wait(1.0 / CLIENT_HZ):
            client.call("status")
            seen["answers"] += 1


def _view_page(port: int, ended: threading.Event, seen: dict[str, int]) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    server, look = "", 0
    while not ended.wait(1.0 / PAGE_HZ):
        connection.request("GET", f"/news?server={server}&after={look}")
        news = json.loads(connection.getresponse().read())
        seen["pictures"] += news["look"] > look
        server, look = news["server"], news["look"]
    connection.close()


def _view_live(port: int, ended: threading.Event, seen: dict[str, int]) -> None:
    protocol = Subprotocol("foxglove.sdk.v1")
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol]) as connection:
        while not ended.is_set():
            try:
                frame = connection.recv(0.5)
            except TimeoutError:
                continue
            except ConnectionClosed:
                return
            if isinstance(frame, bytes):
                seen["messages"] += 1
            elif json.loads(frame)["op"] == "advertise":
                ids = [channel["id"] for channel in json.loads(frame)["channels"]]
                wanted = [{"id": one, "channelId": one} for one in ids]
                connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def window(bench: Bench) -> tuple[int, int]:
    """Return the numbers of the first and the last tick of a measured interval."""
    time.sleep(SETTLE_S)
    first = bench.ask("status")["tick"]["tick"]
    time.sleep(WINDOW_S)
    return int(first), int(bench.ask("status")["tick"]["tick"])


def looking_on(bench: Bench, rounds: int) -> dict[str, Any]:
    """Wake-up and tick, unwatched and watched, in turn within one log."""
    log_path = bench.hold(8e-3)
    windows: dict[str, list[tuple[int, int]]] = {case: [] for case in CASES}
    seen = {"answers": 0, "pictures": 0, "messages": 0}
    for index in range(rounds):
        for case in CASES if index % 2 == 0 else CASES[::-1]:
            with ExitStack() as stack:
                if case == "watched":
                    stack.enter_context(onlookers(bench, seen))
                windows[case].append(window(bench))
    bench.ask("stop")
    bench.wait_for(lambda status: not status["log"])
    log = read(log_path)
    report: dict[str, Any] = {"rounds": rounds, "seconds_each": WINDOW_S, "received": seen}
    chosen = {
        case: [(log["tick"] >= a) & (log["tick"] <= b) for a, b in windows[case]] for case in CASES
    }
    for case in CASES:
        report[case] = {"missed_ticks": [int(log["missed"][rows].sum()) for rows in chosen[case]]}
    report["ratio"] = {}
    for name, column in (("wake_up_us", "late_s"), ("tick_us", "compute_s")):
        each = {case: _percentiles([log[column][rows] for rows in chosen[case]]) for case in CASES}
        for case in CASES:
            report[case][name] = _spread(each[case])
        # By round: a disturbance of the machine affects both halves of a round.
        report["ratio"][name] = _spread(each["watched"] / each["alone"])
    return report


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
    times_ms = [_emergency_stop_ms(bench) for _ in range(count)]
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
    missed = (f"{case} {looked[case]['missed_ticks']}" for case in CASES)
    lines.append(f"missed ticks in each round: {', '.join(missed)}")
    stop = report["emergency_stop"]
    lines.append(f"emergency stop: {stop['p50_ms']:.1f} ms p50, {stop['max_ms']:.1f} ms max")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--stops", type=int, default=20)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        bench = Bench(Path(temporary))
        try:
            report = {
                "looking_on": looking_on(bench, options.rounds),
                "emergency_stop": emergency_stops(bench, options.stops),
            }
        finally:
            bench.close()
    print(json.dumps(report, indent=1))
    print(table(report), file=sys.stderr)


if __name__ == "__main__":
    main()
