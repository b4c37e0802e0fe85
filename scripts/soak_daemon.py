"""A long day of the daemon in half an hour: random commands, faults, kills; then leaks.

    python scripts/soak_daemon.py --minutes 30 > soak.json

JSON on stdout, progress on stderr; exit code 3 if anything went wrong. The loops, recorders and
guardians of one daemon are killed and frozen: its memory and file descriptors are compared between
idle moments. At the end no process and nothing in shared memory may be left, and every log must
pass `pamctl log check` and `pamctl replay`. Deaths of the daemon itself: `fault_rounds.py`.
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
from contextlib import suppress
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from support.patience import PATIENCE_S, await_true
from support.processes.children import list_children

from hal.sim import peek_v
from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError
from pamctl.daemon.protocol import INTERNAL_ERROR
from pamctl.log import read
from pamctl.offline.tick_replay import replay_log
from pamctl.processes.backends import SHARED_MEMORY, ao_path
from pamctl.settings.resolve import resolve, settings_to_data

SAMPLE_EVERY_S = 10.0
WARM_UP_SHARE = 0.25
MOST_GROWTH_BYTES = 4e6
"""After the warm-up. The largest answer takes 2 MB while it is written."""
AO_STEP_V = 20.0 / 65536.0
SETTINGS = ["rig.homing.steady_s=0.05", "rig.homing.fills=1"]
EXPERIMENTS: list[dict[str, Any]] = [
    {"kind": "square", "frequency_hz": 2.0, "cycles": 2},
    {
        "kind": "tracking", "offset_mm": 8.0, "amplitude_mm": 3.0, "transition_s": 1.0,
        "approach_s": 1.0, "settle_s": 0.2, "cycles": 1,
    },
]  # fmt: skip
CONTROLLERS = {
    name: settings_to_data(resolve(controller=name).controller) for name in ("qsmc", "pid")
}


class Rig:
    """The daemon under test, and the actions on it."""

    def __init__(self, folder: Path) -> None:
        self.device = f"soak{os.getpid()}"
        self.socket, self.logs = folder / "control.sock", folder / "logs"
        self._errors = (folder / "daemon.err").open("wb")
        self.process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "pamctl", "daemon", "--socket", str(self.socket)]
        command += ["--logs", str(self.logs)]
        settings = [f"rig.sim.device={self.device}", *SETTINGS]
        command += [part for setting in settings for part in ("--set", setting)]
        process = subprocess.Popen(command, stderr=self._errors)
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            with suppress(DaemonUnreachableError), Client(self.socket) as client:
                client.call("status")
                return process
            if process.poll() is not None or time.monotonic() > deadline_s:
                raise AssertionError(f"the daemon does not start, exit code {process.poll()}")
            time.sleep(0.05)

    def ask(self, method: str, **params: Any) -> Any:
        """Ask; a refusal is a valid answer, an internal error of the daemon is not."""
        try:
            with Client(self.socket) as client:
                return client.call(method, params)
        except DaemonDeclinedError as error:
            if error.code == INTERNAL_ERROR:
                raise AssertionError(f"{method}: {error}") from error
            return None

    def status(self) -> dict[str, Any]:
        """Ask for the status."""
        status: dict[str, Any] = self.ask("status")
        return status

    def kill(self, which: str, number: signal.Signals) -> None:
        """Send a signal to one of the daemon's processes, if it exists."""
        for pid in list_children(self.process.pid):
            with suppress(OSError):
                if which in Path(f"/proc/{pid}/cmdline").read_text():
                    os.kill(pid, number)

    def to_idle(self) -> None:
        """Acknowledge a latched fault, end the current run, and wait until the daemon is idle."""
        deadline_s = time.monotonic() + PATIENCE_S
        while (status := self.status())["state"] != "idle":
            self.ask("ack" if status["state"] == "fault" else "disarm")
            if time.monotonic() > deadline_s:
                raise AssertionError(f"it does not become idle: {status}")
            time.sleep(0.05)
        self.require_safe()

    def require_safe(self) -> None:
        """Require the safe voltage at the output."""
        volts = peek_v(ao_path(self.device))
        if volts is None or abs(volts) > AO_STEP_V:
            raise AssertionError(f"{volts} V at the output of an idle daemon")

    def sample(self) -> dict[str, float]:
        """The resources of an idle daemon."""
        self.to_idle()
        await_true(lambda: not list_children(self.process.pid), "processes left behind when idle")
        pid = self.process.pid
        return {
            "t_s": time.monotonic(),
            "rss_bytes": resident_bytes(pid),
            "fds": len(os.listdir(f"/proc/{pid}/fd")),
            "threads": len(os.listdir(f"/proc/{pid}/task")),
            "shared_memory": len(self.shared_memory()),
        }

    def shared_memory(self) -> list[str]:
        """Our files in shared memory, without output and lock of the device, which stay."""
        rings = SHARED_MEMORY.glob(f"pamctl-{self.process.pid}-*")
        device = SHARED_MEMORY.glob(f"pamctl-{self.device}.*")
        return [p.name for p in (*rings, *device) if p.suffix not in (".ao", ".lock")]

    def end(self) -> None:
        """Stop it as a service manager does."""
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(PATIENCE_S)
        self._errors.close()
        if code:
            raise AssertionError(f"it left with {code} on SIGTERM")


def resident_bytes(pid: int) -> int:
    """Private memory: without maps of files and of shared memory."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) * 1024
    raise AssertionError("no RssAnon")


def acts(rig: Rig, dice: random.Random) -> dict[str, tuple[int, Any]]:
    """The actions, each with its weight."""

    def start() -> None:
        rig.ask("start", experiment=dice.choice(EXPERIMENTS), name="soak")

    def load() -> None:
        name = dice.choice(list(CONTROLLERS))
        rig.ask("load", controller=CONTROLLERS[name], name=name)

    def set_gain() -> None:
        change = f"controller.lpf1_hz={dice.uniform(60, 120):.3f}"
        rig.ask("set", changes=[change], ramp_s=dice.choice([0.0, 0.2, 1.0]))

    return {
        "start": (10, start),
        "goto": (10, lambda: rig.ask("goto", position_m=dice.uniform(2e-3, 14e-3))),
        "stop": (6, lambda: rig.ask("stop")),
        "set": (6, set_gain),
        "load": (3, load),
        "mark": (4, lambda: rig.ask("mark", text="soak")),
        "status": (4, lambda: rig.ask("status")),
        "recent": (4, lambda: rig.ask("recent", every=dice.choice([1, 10]))),
        "ack": (8, lambda: rig.ask("ack")),
        "estop": (2, lambda: rig.ask("estop")),
        "disarm": (2, lambda: rig.ask("disarm")),
        "kill loop": (1, lambda: rig.kill("loop_main", signal.SIGKILL)),
        "freeze loop": (1, lambda: rig.kill("loop_main", signal.SIGSTOP)),
        "kill recorder": (1, lambda: rig.kill("recording.recorder", signal.SIGKILL)),
        "kill guardian": (1, lambda: rig.kill("guardian_main", signal.SIGKILL)),
    }


def one_life(rig: Rig, dice: random.Random, seconds: float, done: Counter[str]) -> list[Any]:
    """Do random actions on one daemon; return its resources at idle moments."""
    samples = [rig.sample()]
    choice = acts(rig, dice)
    weights = [weight for weight, _ in choice.values()]
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        (name,) = dice.choices(list(choice), weights)
        choice[name][1]()
        done[name] += 1
        time.sleep(dice.choice([0.0, 0.05, 0.3, 1.0]))
        if time.monotonic() - samples[-1]["t_s"] > SAMPLE_EVERY_S:
            samples.append(rig.sample())
            print(f"{sum(done.values())} acts, {samples[-1]}", file=sys.stderr)
    samples.append(rig.sample())
    return samples


def judge_logs(folder: Path) -> tuple[int, int, list[str]]:
    """Return the number of logs and of ticks, and the problems of the logs."""
    logs, ticks, wrong = sorted(folder.glob("*.mcap")), 0, []
    left = [path.name for path in folder.iterdir() if path.suffix != ".mcap"]
    if left:
        wrong.append(f"left behind: {left}")
    for path in logs:
        command = [sys.executable, "-m", "pamctl", "log", "check", str(path)]
        checked = subprocess.run(command, capture_output=True, text=True)
        if checked.returncode:
            wrong.append(f"{path.name}: {checked.stdout}{checked.stderr}")
            continue
        log = read(path)
        ticks += len(log)
        replayed = replay_log(log) if len(log) else None
        if replayed is not None and not replayed.is_equal:
            left_out = (replayed.skipped, replayed.unasked)
            wrong.append(f"{path.name}: replay differs: {replayed.differences[:1]}, {left_out}")
    return len(logs), ticks, wrong


def growth(samples: list[dict[str, float]]) -> dict[str, float]:
    """Slope and maximum of memory since the warm-up; change of everything else.

    For descriptors and threads the minimum counts, early and late: a client holds one of them for a
    moment.
    """
    settled = samples[int(len(samples) * WARM_UP_SHARE) :]
    third = len(settled) // 3

    def more(what: str) -> float:
        early, late = settled[: third or None], settled[-third:]
        return min(s[what] for s in late) - min(s[what] for s in early)

    t_h = np.array([sample["t_s"] for sample in settled]) / 3600.0
    rss = np.array([sample["rss_bytes"] for sample in settled])
    return {
        "rss_bytes_per_h": float(np.polyfit(t_h - t_h[0], rss, 1)[0]),
        "rss_growth_bytes": float(rss.max() - rss[0]),
        "rss_begun_bytes": float(samples[0]["rss_bytes"]),
        "rss_warm_bytes": float(rss[0]),
        "rss_last_bytes": float(rss[-1]),
        "fds": more("fds"),
        "threads": more("threads"),
        "shared_memory": settled[-1]["shared_memory"],
        "samples": len(settled),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="a directory for logs and messages")
    options = parser.parse_args()
    if options.minutes < 2.0:
        parser.error("less than two minutes cannot show a leak")
    dice, done, wrong = random.Random(options.seed), Counter[str](), list[str]()
    report: dict[str, Any] = {"minutes": options.minutes, "seed": options.seed}
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        rig = Rig(folder)
        try:
            samples = one_life(rig, dice, options.minutes * 60.0, done)
            report["growth"] = found = growth(samples)
            if found["rss_growth_bytes"] > MOST_GROWTH_BYTES:
                wrong.append("memory grows")
            if found["fds"] > 0 or found["threads"] > 1 or found["shared_memory"]:
                wrong.append("file descriptors, threads or shared memory grow")
            rig.to_idle()
            rig.end()
            if rig.shared_memory():
                wrong.append(f"left in shared memory: {rig.shared_memory()}")
        except (AssertionError, DaemonUnreachableError, subprocess.TimeoutExpired) as amiss:
            wrong.append(f"{type(amiss).__name__}: {amiss}")
        finally:
            rig.process.kill()
            for left in SHARED_MEMORY.glob(f"pamctl-{rig.device}.*"):
                left.unlink()
        report["logs"], report["ticks"], wrong_logs = judge_logs(rig.logs)
        said = (folder / "daemon.err").read_text()
        if "Traceback" in said:
            wrong.append(said[said.index("Traceback") :][:2000])
    report |= {"acts": dict(done), "amiss": wrong + wrong_logs}
    print(json.dumps(report, indent=1))
    print(
        f"{report['logs']} logs, {sum(done.values())} actions, wrong: {len(report['amiss'])}",
        file=sys.stderr,
    )
    return 3 if report["amiss"] else 0


if __name__ == "__main__":
    sys.exit(main())
