"""Speed of the replay, and the cost of a long log: time and memory of the verbs that read it all.

    python scripts/bench_replay.py [--hours 1] [--log FILE] [--json]

Makes a log of experiment 2 without a clock, or uses an existing one. Every verb runs in a separate
process with warm caches. Prints one JSON document, and a table on stderr.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PAMCTL = (sys.executable, "-m", "pamctl")
VERBS: Mapping[str, Sequence[str]] = {
    "info": ("log", "info"),
    "check": ("log", "check"),
    "replay": ("replay",),
    "compare": ("compare",),
}
_CYCLE_S = 10.0


def make_log(log: Path, hours: float) -> dict[str, float]:
    """Run experiment 2 for this time; return how long that took."""
    seconds = 3600.0 * hours
    cycles = f"experiment.cycles={max(1, round(seconds / _CYCLE_S) + 1)}"
    command = ["run", "--fast", "--quiet", "--duration", f"{seconds:g}", "--log", str(log)]
    began_s = time.perf_counter()
    ran = subprocess.run(
        [*PAMCTL, *command, "--set", cycles], stdout=subprocess.DEVNULL, check=True
    )
    assert ran.returncode == 0
    return {"took_s": time.perf_counter() - began_s}


def cost(verb: Sequence[str], log: Path) -> dict[str, Any]:
    """Run a verb on a log; return time, processor time and peak memory."""
    with tempfile.TemporaryFile() as out:
        began_s = time.perf_counter()
        process = subprocess.Popen([*PAMCTL, *verb, str(log), "--json"], stdout=out)
        _, status, used = os.wait4(process.pid, 0)
        took_s = time.perf_counter() - began_s
        out.seek(0)
        said = json.loads(out.read() or "{}")
    return {
        "took_s": took_s,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
        "exit_code": os.waitstatus_to_exitcode(status),
        **{key: said[key] for key in ("speed_x_real_time", "equal", "ticks") if key in said},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--log", type=Path, help="measure this log instead of making one")
    parser.add_argument("--verbs", nargs="*", default=list(VERBS), choices=list(VERBS))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        log = arguments.log or Path(directory) / "long.mcap"
        result: dict[str, Any] = {}
        if arguments.log is None:
            result["made"] = make_log(log, arguments.hours)
        result["bytes"] = log.stat().st_size
        for name in arguments.verbs:
            result[name] = found = cost(VERBS[name], log)
            print(
                f"{name:<10}{found['took_s']:>8.1f} s{found['peak_mb']:>10.0f} MB"
                f"{found.get('speed_x_real_time', 0):>10.0f} x real time",
                file=sys.stderr,
            )
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
