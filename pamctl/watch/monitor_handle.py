"""The daemon's side of the monitor: start it, take its reports, say them, do without it."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from hal.child import child_command
from pamctl.plant.model import PlantSettings

_PATIENCE_S = 2.0

Told = Callable[[Mapping[str, Any]], object]


class MonitorHandle:
    """A monitor process. Nothing here waits for it, and nothing needs it."""

    def __init__(self, plant: PlantSettings, on_event: Told) -> None:
        """Start it. `on_event` is called from a thread with alarms and explanations."""
        self._on_event = on_event
        self._state: dict[str, Any] = {"blocks": [], "explanation": None, "problem": ""}
        # Its own process group gets no Ctrl-C. It leaves when its standard input ends.
        self._process = subprocess.Popen(
            child_command("pamctl.watch.monitor_main"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,
        )
        assert self._process.stdin is not None
        self._fd = self._process.stdin.fileno()
        self._send(plant.model_dump_json())
        os.set_blocking(self._fd, False)
        self._reader = threading.Thread(target=self._read, name="monitor", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def status(self) -> dict[str, Any]:
        """Return the newest report, for the daemon's status."""
        code = self._process.poll()
        problem = self._state["problem"] if code is None else f"exit code {code}"
        return {**self._state, "alive": code is None, "problem": problem}

    def begin_run(self, name: str, ring: Path) -> None:
        """Let it follow a run. A monitor that does not read its orders misses the run."""
        self._send(json.dumps({"run": name, "ring": str(ring)}))

    def _send(self, line: str) -> None:
        with suppress(BlockingIOError, BrokenPipeError):
            os.write(self._fd, line.encode() + b"\n")

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._take(json.loads(line))
        self._process.wait()
        if self._fd >= 0:
            self._on_event({"kind": "ended", "problem": self.status()["problem"]})

    def _take(self, report: dict[str, Any]) -> None:
        match report["kind"]:
            case "state":
                self._state["blocks"] = report["blocks"]
                return
            case "run":
                self._state["problem"] = ""
                return
            case "problem":
                self._state["problem"] = report["problem"]
                return
            case "alarm":
                self._state["explanation"] = None
            case "explained":
                told = {k: v for k, v in report.items() if k != "kind"}
                self._state["explanation"] = told
            case "ready":
                return
        self._on_event(report)

    def close(self) -> None:
        """End it; kill it if it does not leave by itself."""
        self._fd = -1
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(_PATIENCE_S)


_UNITS = {"pressure": (1.0, "Pa"), "mechanics": (1e6, "um")}
_STILL = {"pressure": "the valve is at rest", "mechanics": "the muscle stands still"}


def format_alarm(alarm: Mapping[str, Any]) -> str:
    """Return an alarm as a sentence: since when, which block, how far off."""
    scale, unit = _UNITS[alarm["block"]]
    at = time.strftime("%H:%M:%S", time.localtime(alarm["since_s"]))
    return (
        f"since {at} the {alarm['block']} block is {alarm['over_floor']:.1f} x its floor "
        f"({scale * alarm['rms']:.3g} {unit} RMS, {alarm['activity']})"
    )


def format_block(block: Mapping[str, Any]) -> str:
    """Return the state of one block in some words."""
    name, state = block["block"], block["state"]
    if block["alarm"] is not None:
        return format_alarm(block["alarm"])
    if state == "cannot tell":
        return f"{name}: cannot tell, {_STILL[name]}"
    return f"{name}: {state}, {block['over_floor']:.1f} x its floor"


def format_monitor(monitor: Mapping[str, Any]) -> str:
    """Return the monitor's state as one line."""
    if not monitor["alive"]:
        return f"monitor: ended ({monitor['problem']})"
    if monitor["problem"]:
        return f"monitor: {monitor['problem']}"
    if not monitor["blocks"]:
        return "monitor: waiting for some seconds of a run"
    words = "; ".join(format_block(block) for block in monitor["blocks"])
    explanation = monitor["explanation"]
    return f"monitor: {words}" + (f"; {explanation['sentence']}" if explanation else "")
