"""A real daemon on a rig that a script makes up: a simulated backend, found as if installed.

Limits that only a busy PC would pass are wide: a real valve would not wait so long.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
PATIENT = (
    "rig.limits.pressure_model_pa=2e6", "rig.limits.sample_age_s=60",
    "rig.limits.missed_ticks=1e6", "rig.loop.heartbeat_ms=5000", "rig.loop.starved_ms=20000",
    "rig.homing.timeout_s=60",
)  # fmt: skip
PATIENCE_S = 600.0


def install_backend(folder: Path, name: str, code: str) -> None:
    """Install a backend from its code, with a rig file like that of the simulated rig.

    The code defines `BACKEND`. The folder must be on PYTHONPATH.
    """
    entry = folder / f"{name}_rigs-0.dist-info"
    entry.mkdir()
    (folder / f"{name}_backend.py").write_text(code)
    (entry / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}-rigs\nVersion: 0\n")
    found = f"[pamctl.rigs]\n{name} = {name}_backend:BACKEND\n"
    (entry / "entry_points.txt").write_text(found)
    rig = yaml.safe_load((ROOT / "config" / "rig" / "sim.yaml").read_text())
    rig["backend"] = name
    rig[name] = rig.pop("sim")
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(rig))


@contextmanager
def hold_daemon(
    folder: Path, name: str, environment: Mapping[str, str], options: Sequence[str] = ()
) -> Iterator[Path]:
    """Run a daemon on that rig within the block; yield its control socket."""
    socket, device = folder / "control.sock", f"{name}-{folder.name}"
    command = [sys.executable, "-m", "pamctl", "daemon", "--rig", str(folder / f"{name}.yaml")]
    command += ["--socket", str(socket), "--logs", str(folder / "logs"), *options]
    for setting in (f"rig.{name}.device={device}", *PATIENT):
        command += ["--set", setting]
    with (folder / "daemon.txt").open("w") as told:
        process = subprocess.Popen(command, env=dict(environment), stdout=told, stderr=told)
    try:
        deadline_s = time.monotonic() + PATIENCE_S
        while not socket.exists() and process.poll() is None and time.monotonic() < deadline_s:
            time.sleep(0.2)
        yield socket
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(60.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for left in Path("/dev/shm").glob(f"pamctl-{device}.*"):
            left.unlink()
