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
from pamctl.base.texts import LONGEST_REMARK
from pamctl.plant.model import PlantSettings

_PATIENCE_S = 2.0
_MARK_PATIENCE_S = 0.1
"""A loop takes a mark within some ticks; a trip waits no longer for it (s)."""


class MonitorHandle:
    """The monitor of one daemon, or none: then every call does nothing. Nobody waits for it."""

    def __init__(
        self,
        plant: PlantSettings | None,
        announce: Callable[..., None],
        mark: Callable[[str], object],
        trip: Callable[[str], None] | None,
    ) -> None:
        """Start a process that follows `plant`; None starts none.

        What it finds is announced, and put into the log as a mark; an alarm calls `trip`, if any.
        All three are called from a thread.
        """
        self._announce, self._mark, self._trip = announce, mark, trip
        self._state: dict[str, Any] = {"blocks": [], "problem": ""}
        self._process: subprocess.Popen[bytes] | None = None
        if plant is None:
            return
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
        args = (self._process,)
        self._reader = threading.Thread(target=self._read, args=args, name="monitor", daemon=True)
        self._reader.start()

    @property
    def pids(self) -> dict[str, int]:
        """Process id, by role."""
        return {} if self._process is None else {"monitor": self._process.pid}

    def status(self) -> dict[str, Any] | None:
        """Return the newest report, with a sentence; None without a monitor."""
        if self._process is None:
            return None
        code = self._process.poll()
        problem = self._state["problem"] if code is None else f"exit code {code}"
        found = {**self._state, "alive": code is None, "problem": problem}
        return {**found, "sentence": format_monitor(found)}

    def begin_run(self, name: str, ring: Path) -> None:
        """Let it follow a run. A monitor that does not read its orders misses the run."""
        if self._process is not None:
            self._send(json.dumps({"run": name, "ring": str(ring)}))

    def _send(self, line: str) -> None:
        with suppress(BlockingIOError, BrokenPipeError):
            os.write(self._fd, line.encode() + b"\n")

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self._take(json.loads(line))
        code = process.wait()
        if self._fd >= 0:
            self._announce("monitor ended", text=f"exit code {code}")

    def _take(self, report: Mapping[str, Any]) -> None:
        told = {key: value for key, value in report.items() if key != "kind"}
        match report["kind"]:
            case "state":
                self._state["blocks"] = report["blocks"]
            case "run":
                self._state["problem"] = ""
            case "problem":
                self._state["problem"] = report["problem"]
            case "alarm":
                self._raise_alarm(format_alarm(report), told)
            case "alarm over":
                text = f"the {report['block']} block is back at its floor"
                self._announce("monitor alarm over", text=text, **told)
                self._note(text)

    def _raise_alarm(self, text: str, told: Mapping[str, Any]) -> None:
        self._announce("monitor alarm", text=text, **told)
        # The log should say why, but the valve does not wait for a mark that is held up.
        note = threading.Thread(target=self._note, args=(text,), daemon=True)
        note.start()
        note.join(None if self._trip is None else _MARK_PATIENCE_S)
        if self._trip is not None:
            self._trip(f"monitor: {text}")

    def _note(self, text: str) -> None:
        self._mark(f"monitor: {text}"[:LONGEST_REMARK])

    def close(self) -> None:
        """End it; kill it if it does not leave by itself."""
        if self._process is None:
            return
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
    is_off = any(block["alarm"] is not None for block in monitor["blocks"])
    return f"monitor: {words}" + ("; `pamctl diagnose` its log after the run" if is_off else "")
