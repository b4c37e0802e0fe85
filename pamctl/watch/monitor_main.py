"""The monitor: `python -m pamctl.watch.monitor_main`, started by `pamctl daemon --monitor`.

Standard input: a line with the plant, then a line for each run with the path of its ring.
Standard output: a line of JSON for each second that was judged, each alarm and each explanation.
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
from contextlib import suppress
from dataclasses import asdict
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pamctl.base.errors import ExitCode
from pamctl.base.worker_processes import start_worker
from pamctl.diagnose.record import Record
from pamctl.log.framing import LogError
from pamctl.plant.model import PlantSettings
from pamctl.recording.ring import RingError
from pamctl.watch.watch_run import BlockReport, RingFollower, RunWatch

if TYPE_CHECKING:  # the diagnosis is imported by the process that needs it
    from pamctl.diagnose import Diagnosis

_NICE, _IDLE_NICE = 10, 19
_LOOK_S = 1.0
_EXPLAIN_S = 40.0
"""Measurement since an alarm's begin that is diagnosed."""
_ENOUGH_S = 8.0
"""Measurement that is diagnosed if the run ends before."""


class Monitor:
    """Follows run after run and reports by `say`."""

    def __init__(self, plant: PlantSettings) -> None:
        self._plant = plant
        self._watch = RunWatch(plant)
        self._follower: RingFollower | None = None
        self._explaining: tuple[SpawnProcess, Connection] | None = None
        self._alarms: dict[str, float] = {}
        self._unexplained_s: float | None = None
        self._wall_s = time.time() - time.monotonic()
        self._began_s = time.monotonic()

    def begin_run(self, ring: Path) -> None:
        """Follow a run from now on."""
        self.end_run()
        self._watch.begin_run()
        self._follower = RingFollower(ring)

    def end_run(self) -> None:
        """Leave the run; what was measured since an alarm is diagnosed if it is enough."""
        if self._follower is not None:
            self._explain(_ENOUGH_S)
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
            self._explain(_EXPLAIN_S)
            if is_over:
                self.end_run()
        self._say_explanation()

    def _report(self, changed: Mapping[str, BlockReport]) -> None:
        if not changed:
            return
        blocks = [self._as_dict(report) for report in self._watch.blocks.values()]
        say("state", blocks=blocks)
        for one in blocks:
            block, alarm = one["block"], one["alarm"]
            if alarm is not None and block not in self._alarms:
                self._alarms[block] = alarm["since_s"]
                since_s = alarm["since_s"] - self._wall_s - self._began_s
                self._unexplained_s = max(self._unexplained_s or 0.0, since_s)
                say("alarm", **alarm)
            elif alarm is None and block in self._alarms:
                say("alarm over", block=block, since_s=self._alarms.pop(block))

    def _explain(self, least_s: float) -> None:
        if self._unexplained_s is None or self._explaining is not None:
            return
        record = self._watch.recall(self._unexplained_s)
        if record is not None and record.duration_s >= least_s:
            self._unexplained_s = None
            self._explaining = start_worker(explain_gently, record, self._plant)

    def _say_explanation(self) -> None:
        if self._explaining is None or not self._explaining[1].poll():
            return
        (worker, answer), self._explaining = self._explaining, None
        try:
            say("explained", **answer.recv())
        except EOFError:
            failed = "the diagnosis of the last minute failed"
            say("explained", sentence=failed, verdict="", effects=[])
        worker.join()
        answer.close()

    def _as_dict(self, report: BlockReport) -> dict[str, Any]:
        told = asdict(report)
        if told["alarm"] is not None:
            told["alarm"]["since_s"] += self._began_s + self._wall_s
        return told

    def close(self) -> None:
        """End a diagnosis that is on its way, and leave the run."""
        if self._explaining is not None:
            self._explaining[0].kill()
        if self._follower is not None:
            self._follower.close()


# --- what an alarm means ------------------------------------------------------------------------


def explain_gently(record: Record, plant: PlantSettings) -> dict[str, Any]:
    """Do what `explain_record` does, in a worker process of its own that takes only idle time."""
    os.nice(_IDLE_NICE)
    with suppress(AttributeError, OSError):  # where the system knows it
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    return explain_record(record, plant)


def explain_record(record: Record, plant: PlantSettings) -> dict[str, Any]:
    """Diagnose a record; return verdict, sentence and names as plain values."""
    from pamctl.diagnose import diagnose, sentence

    found = diagnose([record], [], plant)
    names, rivals = _list_names(found), _list_rivals(found)
    numbers = {n.name: n.as_dict() for n in found.numbers if n.name.split(".")[0] in names}
    text = f"best explanation: {sentence(found)}"
    if rivals:
        text += f"; not refuted: {', '.join(rivals)}"
    return {
        "sentence": text,
        "verdict": found.verdict.value,
        "effects": names,
        "not_refuted": rivals,
        "numbers": numbers,
        "seconds": record.duration_s,
    }


def _list_names(found: Diagnosis) -> list[str]:
    return [f.name for f in found.findings if f.level != "rest"]


def _list_rivals(found: Diagnosis) -> list[str]:
    """Return what the data do not refute beside the names, without freer terms of a sure name."""
    names = _list_names(found)
    open_ones = [f for f in found.findings if f.level not in ("name", "rest")]
    rivals = dict.fromkeys(r.name for f in open_ones for r in f.rivals)
    return [name for name in rivals if name not in names]


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
            monitor.close()
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
