"""The monitor: `python -m pamctl.watch.monitor_main`, started by `pamctl daemon --monitor`.

Standard input: a line with the plant, then a line for each run with the path of its ring.
Standard output: a line of JSON for each second that was judged, and for each alarm.
It ends when its standard input does, and it is the first to give way when the CPU is short.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pamctl.base.errors import ExitCode
from pamctl.log.framing import LogError
from pamctl.plant.model import PlantSettings
from pamctl.recording.ring import RingError
from pamctl.watch.watch_run import BlockReport, RingFollower, RunWatch

_NICE = 10
_LOOK_S = 1.0


class Monitor:
    """Follows run after run and reports by `say`."""

    def __init__(self, plant: PlantSettings) -> None:
        self._plant = plant
        self._watch = RunWatch(plant)
        self._follower: RingFollower | None = None
        self._alarms: dict[str, float] = {}
        self._wall_s = time.time() - time.monotonic()
        self._began_s = time.monotonic()

    def begin_run(self, ring: Path) -> None:
        """Follow a run from now on."""
        self.end_run()
        self._watch.begin_run()
        self._follower = RingFollower(ring)

    def end_run(self) -> None:
        """Leave the run."""
        if self._follower is not None:
            self._follower.close()
            self._follower = None

    @property
    def wait_s(self) -> float:
        """Time until the next look."""
        longest_s = self._follower.longest_wait_s if self._follower else _LOOK_S
        return min(_LOOK_S, longest_s)

    def look(self) -> None:
        """Judge what is new; report."""
        follower = self._follower
        if follower is not None:
            is_over, found = follower.is_over, follower.read()
            if found is not None:
                measured, start_s = found
                self._report(self._watch.take(measured, start_s - self._began_s))
            if is_over:
                self.end_run()

    def _report(self, changed: Mapping[str, BlockReport]) -> None:
        if not changed:
            return
        blocks = [self._as_dict(report) for report in self._watch.blocks.values()]
        say("state", blocks=blocks)
        for one in blocks:
            block, alarm = one["block"], one["alarm"]
            if alarm is not None and block not in self._alarms:
                self._alarms[block] = alarm["since_s"]
                say("alarm", **alarm)
            elif alarm is None and block in self._alarms:
                say("alarm over", block=block, since_s=self._alarms.pop(block))

    def _as_dict(self, report: BlockReport) -> dict[str, Any]:
        told = asdict(report)
        if told["alarm"] is not None:
            told["alarm"]["since_s"] += self._began_s + self._wall_s
        return told


# --- the process --------------------------------------------------------------------------------


def say(kind: str, **details: object) -> None:
    """Write one line of JSON on standard output."""
    line = json.dumps({"kind": kind, **details}).encode() + b"\n"
    while line:
        line = line[os.write(1, line) :]


def main() -> int:
    """Watch until standard input ends."""
    os.nice(_NICE)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the daemon
    with os.fdopen(0, "rb", buffering=0) as source:
        monitor = Monitor(PlantSettings.model_validate_json(source.readline()))
        say("ready")
        try:
            _watch_until_end(monitor, source.fileno())
        except BrokenPipeError:
            pass  # the daemon has gone
        finally:
            monitor.end_run()
    return int(ExitCode.OK)


def _watch_until_end(monitor: Monitor, orders: int) -> None:
    text, due_s = b"", time.monotonic()
    while True:
        ready, _, _ = select.select([orders], [], [], max(0.0, due_s - time.monotonic()))
        if ready:
            part = os.read(orders, 65536)
            if not part:
                return
            *lines, text = (text + part).split(b"\n")
            for line in lines:
                _obey(monitor, json.loads(line))
            continue
        due_s = time.monotonic() + monitor.wait_s
        try:
            monitor.look()
        except LogError as error:
            monitor.end_run()
            say("problem", problem=f"this run cannot be watched: {error}")


def _obey(monitor: Monitor, order: Mapping[str, Any]) -> None:
    try:
        monitor.begin_run(Path(order["ring"]))
    except RingError as error:  # a run that was over at once
        say("problem", problem=f"this run cannot be watched: {error}")
    else:
        say("run", run=order["run"])


if __name__ == "__main__":
    sys.exit(main())
