"""What the guardian is for: from the death or the freezing of the loop to the safe voltage.

    python scripts/bench_guardian.py --rounds 10 > guardian.json

JSON on stdout, a table on stderr. Real runs of the simulated rig in real time, the loop ended
by a real signal at a random moment of the experiment. The output register is looked at all the
time, as with a voltmeter; the clock starts before the signal is sent. A tick is lost if the
ring held it at the loop's death and the finished log does not.
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
from pathlib import Path
from statistics import median

from hal.register import peek_v
from pamctl.cli.assembly import SHARED_MEMORY, ao_path
from pamctl.log.reader import read
from pamctl.realtime.ring import Ring

DEVICE = f"bench{os.getpid()}"
SAFE_V, AO_STEP_V = 0.0, 20.0 / 65536.0
CASES = {
    "killed": (signal.SIGKILL, 20.0),
    "frozen": (signal.SIGSTOP, 100.0),
}
"""The signal, and the target for the time to the safe voltage in ms."""


def round_of(folder: Path, name: str, number: signal.Signals) -> tuple[float, int]:
    """One run that ends with `number`; ms to the safe voltage, and ticks lost."""
    path = folder / f"{name}.mcap"
    command = [sys.executable, "-m", "pamctl", "run", "--quiet", "--log", str(path)]
    options = ["--set", f"rig.sim.device={DEVICE}"]
    with subprocess.Popen([*command, *options], stdout=subprocess.DEVNULL) as front:
        with Ring.attach(ring_of(front)) as ring:
            while ring.head < 2600:
                require_alive(front)
            time.sleep(random.uniform(0.0, 1.0))
            took_ms = safe_after_ms(ring.loop_pid, number)
            tick = ring.latest_tick()
        front.wait()
    assert tick is not None
    return took_ms, int(tick["tick"]) - int(read(path)["tick"][-1])


def ring_of(front: subprocess.Popen[bytes]) -> Path:
    """Wait for the ring of a run."""
    while True:
        require_alive(front)
        for path in SHARED_MEMORY.glob(f"pamctl-{front.pid}-*.ring"):
            return path


def require_alive(front: subprocess.Popen[bytes]) -> None:
    """Pause, and give up on a run that has ended before its time."""
    time.sleep(0.01)
    if front.poll() is not None:
        raise SystemExit(f"the run ended with code {front.returncode}")


def safe_after_ms(loop: int, number: signal.Signals) -> float:
    """Send the loop a signal, and watch the output."""
    output = ao_path(DEVICE)
    assert peek_v(output) > SAFE_V + AO_STEP_V, "the valve was safe already"
    began_s = time.perf_counter()
    os.kill(loop, number)
    while peek_v(output) > SAFE_V + AO_STEP_V:
        time.sleep(1e-4)
    return (time.perf_counter() - began_s) * 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=10)
    rounds = parser.parse_args().rounds
    results: dict[str, list[tuple[float, int]]] = {name: [] for name in CASES}
    with tempfile.TemporaryDirectory() as temporary:
        for index in range(rounds):  # in turn, so that both see the same PC
            for name, (number, _) in CASES.items():
                found = round_of(Path(temporary), f"{name}-{index}", number)
                results[name].append(found)
    for suffix in ("ao", "lock"):
        ao_path(DEVICE).with_suffix(f".{suffix}").unlink(missing_ok=True)
    report = {}
    for name, (_, target_ms) in CASES.items():
        times_ms = [took_ms for took_ms, _ in results[name]]
        report[name] = {
            "safe_after_ms": {"p50": median(times_ms), "max": max(times_ms), "all": times_ms},
            "target_ms": target_ms,
            "ticks_lost": sum(lost for _, lost in results[name]),
            "rounds": rounds,
        }
        print(
            f"loop {name}: safe voltage after {median(times_ms):.1f} ms (p50), "
            f"{max(times_ms):.1f} ms (max), target {target_ms:.0f}; "
            f"{report[name]['ticks_lost']} ticks lost in {rounds} rounds",
            file=sys.stderr,
        )
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
