"""What the first hour costs a new user: each verb's first and second call in an empty home.

    python scripts/bench_cold.py > cold.json
    python scripts/bench_cold.py . ../other-checkout --rounds 3 > pair.json

JSON on stdout, tables on stderr. Each checkout's own program `.venv/bin/pamctl` runs; HOME and the
cache are an empty folder, where the verbs follow each other as a user types them. Processor seconds
are those of all processes that descend from the call, while it lasts. What one of them goes on with
afterwards counts for the next call, and after the last one as `left`. `missed` are the ticks missed
in the call's run in real time.

A wrapper around the C compiler says what each library cost to build (processor seconds). The files
that are new in the cache are counted, however they were built. Before each round of a checkout, ten
million additions in a Python loop are timed: the measure of this machine now.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pamctl.log import info  # noqa: E402

CALLS = ("first", "second")
LIVE_S = 3.0
PATIENCE_S = 3600.0
PLANT = "effects:\n  valve_deadband: {fill_width_v: 0.25, exhaust_width_v: 0.2}\n"
YARDSTICK = "total = 0\nfor number in range(10_000_000):\n    total += number"
_SUBREAPER = 36
"""PR_SET_CHILD_SUBREAPER: whose parent has ended becomes a child of this process."""
_WRAPPER = """#!/bin/bash
TIMEFORMAT="%U %S"
made="{folder}/$$-$RANDOM"
printf "%s\\n" "$*" >"$made.arguments"
{{ time "{compiler}" "$@" 2>&3; }} 3>&2 2>"$made.seconds"
"""

Figures = dict[str, Any]


class Home:
    """An empty home of one checkout, and what has been called there."""

    def __init__(self, checkout: Path, folder: Path) -> None:
        self._program = checkout / ".venv" / "bin" / "pamctl"
        self.folder, self._cache, self._builds = folder, folder / "cache", folder / "builds"
        wrapped = folder / "bin"
        for place in (self._cache, self._builds, wrapped):
            place.mkdir(parents=True)
        for name in ("cc", "gcc", "clang"):
            if compiler := shutil.which(name):
                text = _WRAPPER.format(folder=self._builds, compiler=compiler)
                (wrapped / name).write_text(text)
                (wrapped / name).chmod(0o755)
        kept = {key: value for key, value in os.environ.items() if not key.startswith("PAMCTL")}
        self._environment = kept | {
            "HOME": str(folder),
            "XDG_CACHE_HOME": str(self._cache),
            "XDG_RUNTIME_DIR": str(folder),
            "PATH": f"{wrapped}:{os.environ['PATH']}",
        }
        self._environment.pop("PYTHONPATH", None)
        self.device = ("--set", f"rig.sim.device=cold{os.getpid()}")

    def call(self, *arguments: str) -> str:
        """Run the program to its end; return what it says on standard error."""
        done = subprocess.run(
            [str(self._program), *arguments], cwd=self.folder, env=self._environment,
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE_S,
            check=False,
        )  # fmt: skip
        if done.returncode:
            raise SystemExit(f"{self._program} {' '.join(arguments)}: {done.stderr.strip()}")
        return done.stderr

    def start(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Start the program."""
        return subprocess.Popen(
            [str(self._program), *arguments], cwd=self.folder, env=self._environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def count_cached(self) -> int:
        """Count the files in the cache."""
        return sum(path.is_file() for path in self._cache.rglob("*"))

    def take_builds(self) -> dict[str, float]:
        """Return the processor seconds of each library that was built since the last time."""
        built: dict[str, float] = {}
        for file in sorted(self._builds.glob("*.seconds")):
            said = file.with_suffix(".arguments").read_text()
            output = re.search(r"-o (\S+)", said)
            seconds = file.read_text().split()[-2:]
            name = Path(output.group(1)).name if output else said.strip()
            built[name] = built.get(name, 0.0) + sum(map(float, seconds))
            file.unlink()
        return built


# --- the calls ---------------------------------------------------------------------------------


def run_live(home: Home, which: str) -> tuple[str, list[Path]]:
    log = home.folder / f"live-{which}.mcap"
    said = home.call("run", "--duration", f"{LIVE_S:g}", "--log", str(log), *home.device)
    return said, [log]


def run_fast(home: Home, which: str) -> tuple[str, list[Path]]:
    return home.call("run", "--fast", "--log", f"fast-{which}.mcap"), []


def record(home: Home, which: str) -> tuple[str, list[Path]]:
    """Make the records of the diagnosis in README.md: two runs, as `first` and `second`."""
    (home.folder / "mine.yaml").write_text(PLANT)
    seed = str(CALLS.index(which) + 1)
    said = home.call(
        "run", "--experiment", "diagnosis", "--plant", "mine.yaml", "--fast", "--seed",
        seed, "--set", f"experiment.seed={seed}", "--log", f"record-{which}.mcap",
    )  # fmt: skip
    return said, []


def diagnose(home: Home, which: str) -> tuple[str, list[Path]]:
    records = ("record-first.mcap", "--holdout", "record-second.mcap")
    return home.call("diagnose", *records, "--out", f"diagnosis-{which}"), []


def compare(home: Home, which: str) -> tuple[str, list[Path]]:
    return home.call("compare", "record-first.mcap", "--plant", "paper"), []


def tune(home: Home, which: str) -> tuple[str, list[Path]]:
    little = ("--ensemble", "2", "--generations", "1", "--held-out", "2")
    return home.call("tune", "--law", "qsmc", *little, "--out", f"gains-{which}.yaml"), []


def replay(home: Home, which: str) -> tuple[str, list[Path]]:
    return home.call("replay", f"fast-{which}.mcap"), []


def daemon(home: Home, which: str) -> tuple[str, list[Path]]:
    """Start a daemon, go to a position, stop, and end the daemon."""
    socket, logs = str(home.folder / f"{which}.sock"), home.folder / f"logs-{which}"
    process = home.start("daemon", "--socket", socket, "--logs", str(logs), *home.device)
    deadline_s = time.monotonic() + PATIENCE_S
    while not Path(socket).exists():
        if process.poll() is not None or time.monotonic() > deadline_s:
            raise SystemExit("the daemon does not come up")
        time.sleep(0.05)
    said = home.call("goto", "12mm", "--socket", socket)
    time.sleep(1.0)
    said += home.call("stop", "--socket", socket)
    process.send_signal(signal.SIGTERM)
    process.wait(PATIENCE_S)
    return said, sorted(logs.glob("*.mcap"))


STEPS: dict[str, Callable[[Home, str], tuple[str, list[Path]]]] = {
    "run": run_live,
    "run --fast": run_fast,
    "records": record,
    "diagnose": diagnose,
    "compare": compare,
    "tune": tune,
    "replay": replay,
    "daemon": daemon,
}
"""In this order: each takes what those before it left."""


# --- their cost --------------------------------------------------------------------------------


def measure_hour(checkout: Path, folder: Path) -> Figures:
    """Return the figures of all calls in a new home."""
    home = Home(checkout, folder)
    hour: Figures = {"additions_s": time_additions(), "calls": {}}
    for name, step in STEPS.items():
        hour["calls"][name] = {}
        for which in CALLS:
            cached, processor_s, begun_s = home.count_cached(), tree_s(), time.monotonic()
            said, logs = step(home, which)
            hour["calls"][name][which] = {
                "processor_s": tree_s() - processor_s,
                "wall_s": time.monotonic() - begun_s,
                "missed": count(logs, "missed_ticks"),
                "ticks": count(logs, "ticks"),
                "built_s": home.take_builds(),
                "new_in_cache": home.count_cached() - cached,
                "notes": re.findall(r".*(?:this time|note:).*", said),
            }
            print(f"{checkout.name}, {name}, {which}: {tell(hour['calls'][name][which])}",
                  file=sys.stderr)  # fmt: skip
    processor_s = tree_s()
    while descendants():
        reap()
        time.sleep(0.1)
    hour["left_s"] = tree_s() - processor_s
    return hour


def count(logs: list[Path], what: str) -> int | None:
    """Return the sum over runs in real time; None where there was none."""
    return sum(info(log)[what] for log in logs) if logs else None


def tree_s() -> float:
    """Return the processor seconds of all that this process started, living or dead."""
    reap()
    dead = resource.getrusage(resource.RUSAGE_CHILDREN)
    ticks = 0
    for pid in descendants():
        with suppress(OSError):
            ticks += sum(map(int, read_stat(pid)[11:15]))
    return dead.ru_utime + dead.ru_stime + ticks / os.sysconf("SC_CLK_TCK")


def descendants() -> list[int]:
    """Return the processes that descend from this one."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                parents[int(entry.name)] = int(read_stat(int(entry.name))[1])
    found, near = [], [os.getpid()]
    while near:
        near = [pid for pid, parent in parents.items() if parent in near]
        found += near
    return found


def read_stat(pid: int) -> list[str]:
    """Return the fields of a process after its name."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def reap() -> None:
    """Wait for processes that ended after their parents: no `Popen` knows them."""
    with suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def time_additions() -> float:
    begun_s = time.process_time()
    exec(YARDSTICK, {})
    return time.process_time() - begun_s


# --- the tables --------------------------------------------------------------------------------


def tell(one: Figures) -> str:
    missed = "" if one["missed"] is None else f", {one['missed']} of {one['ticks']} ticks missed"
    built = f", built {len(one['built_s'])} in {sum(one['built_s'].values()):.2f} s"
    files = f", {one['new_in_cache']} files new"
    return f"{one['processor_s']:.2f} s, {one['wall_s']:.2f} s on the clock{missed}{built}{files}"


def write_tables(report: dict[str, list[Figures]]) -> str:
    """Return the tables: minimum and median of the rounds."""
    lines = []
    for checkout, hours in report.items():
        additions = spread([hour["additions_s"] for hour in hours])
        lines += [
            f"\n{checkout}, ten million additions {additions} s",
            f"{'':<12}{'first: cpu s':>16}{'wall s':>16}{'missed':>10}"
            f"{'second: cpu s':>18}{'wall s':>16}{'missed':>10}",
        ]
        for name in hours[0]["calls"]:
            line = f"{name:<12}"
            for which, width in zip(CALLS, (16, 18), strict=True):
                calls = [hour["calls"][name][which] for hour in hours]
                line += f"{spread([call['processor_s'] for call in calls]):>{width}}"
                line += f"{spread([call['wall_s'] for call in calls]):>16}"
                missed = [call["missed"] for call in calls if call["missed"] is not None]
                line += f"{median(missed) if missed else '-':>10}"
            lines.append(line)
        together = [sum(call["processor_s"] for call in calls_of(hour)) for hour in hours]
        left, built = [hour["left_s"] for hour in hours], [list_builds(hour) for hour in hours]
        lines += [
            f"together {spread(together)} s of processor time, and {spread(left)} s left to do",
            f"the compiler: {spread([sum(one.values()) for one in built])} s, of it for",
            *(f"  {library}: {seconds:.2f} s" for library, seconds in built[0].items()),
        ]
    return "\n".join(lines)


def calls_of(hour: Figures) -> list[Figures]:
    """Return all calls of an hour."""
    return [call for step in hour["calls"].values() for call in step.values()]


def list_builds(hour: Figures) -> dict[str, float]:
    """Return what each library took, most first; one that was built again counts again."""
    built: dict[str, float] = defaultdict(float)
    for call in calls_of(hour):
        for library, seconds in call["built_s"].items():
            built[library] += seconds
    return dict(sorted(built.items(), key=lambda one: -one[1]))


def spread(values: list[float]) -> str:
    """Return minimum and median; of one round its value."""
    least = f"{min(values):.2f}"
    return least if len(values) == 1 else f"{least}..{median(values):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("checkouts", nargs="*", type=Path, default=[ROOT], help="with a .venv each")
    parser.add_argument("--rounds", type=int, default=1)
    given = parser.parse_args()
    ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)
    checkouts = [checkout.resolve() for checkout in given.checkouts]
    for checkout in checkouts:  # no call may compile sources
        rooms = [str(checkout / room) for room in ("pamctl", "hal")]
        python = str(checkout / ".venv" / "bin" / "python")
        subprocess.run([python, "-m", "compileall", "-qq", *rooms], check=False)
    report: dict[str, list[Figures]] = {str(checkout): [] for checkout in checkouts}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        for index in range(given.rounds):
            for place, checkout in enumerate(checkouts[:: 1 if index % 2 else -1]):
                folder = Path(temporary, f"{index}-{place}")
                report[str(checkout)].append(measure_hour(checkout, folder))
    for left in Path("/dev/shm").glob(f"pamctl-cold{os.getpid()}.*"):
        left.unlink()
    print(write_tables(report), file=sys.stderr)
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
