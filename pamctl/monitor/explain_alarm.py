"""The diagnosis of the last minute, in a process that gives way to everything else.

`python -m pamctl.monitor.explain_alarm`: takes a pickle of record and plant on its standard input,
which then stays open, and prints one line of JSON. It ends when its standard input does.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import threading
from contextlib import suppress
from typing import Any

from pamctl.diagnose.measured.record import Record
from pamctl.exit_codes import ExitCode
from pamctl.plant.model import PlantSettings

_IDLE_NICE = 19


class AlarmExplainer:
    """One diagnosis at a time, in a process of its own."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a diagnosis is on its way."""
        return self._process is not None

    def start(self, record: Record, plant: PlantSettings) -> None:
        """Begin the diagnosis of a record."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "pamctl.monitor.explain_alarm"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            pickle.dump((record, plant), self._process.stdin)
            self._process.stdin.flush()

    def collect(self) -> dict[str, Any] | None:
        """Return the explanation once it is there; None before."""
        process = self._process
        if process is None or process.poll() is None:
            return None
        assert process.stdout is not None
        text = process.stdout.read()
        self.stop()
        with suppress(ValueError):
            found: dict[str, Any] = json.loads(text)
            return found
        failed = f"the diagnosis of the last minute failed (exit code {process.returncode})"
        return {"sentence": failed, "verdict": "", "effects": []}

    def stop(self) -> None:
        """End a diagnosis that is on its way."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()


def explain_record(record: Record, plant: PlantSettings) -> dict[str, Any]:
    """Diagnose a record; return verdict, sentence and names as plain values."""
    from pamctl.diagnose import diagnose, sentence

    found = diagnose([record], [], plant)
    names = [standing.effect.name for standing in found.standings]
    rivals = [r.name for s in found.standings for r in s.rivals if r.is_equal]
    numbers = {n.name: n.as_dict() for n in found.numbers if n.name.split(".")[0] in names}
    text = f"best explanation: {sentence(found)}"
    if rivals:
        text += f"; not refuted: {', '.join(dict.fromkeys(rivals))}"
    return {
        "sentence": text,
        "verdict": found.verdict.value,
        "effects": names,
        "not_refuted": list(dict.fromkeys(rivals)),
        "numbers": numbers,
        "seconds": record.duration_s,
    }


def main() -> int:
    """Diagnose what standard input holds."""
    os.nice(_IDLE_NICE)
    with suppress(AttributeError, OSError):  # where the system knows it: only idle time
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    record, plant = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    found = explain_record(record, plant)
    sys.stdout.write(json.dumps(found) + "\n")
    sys.stdout.flush()
    return int(ExitCode.OK)


def _leave_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(int(ExitCode.OK))


if __name__ == "__main__":
    sys.exit(main())
