"""The front's side of the guardian: start it, notice its death, ask what it did."""

from __future__ import annotations

import json
import select
import subprocess
from collections.abc import Sequence

from hal.rig import Rig
from pamctl.exit_codes import Ending, ExitCode
from pamctl.processes.guardian import Takeover, drive_safe
from pamctl.recording.ring import Ring

_REPORT_PATIENCE_S = 1.0
"""If the guardian takes longer, the front does its work."""
_LEAVE_PATIENCE_S = 2.0


class Guardianship:
    """The guardian of one run. Without a `command` there is none, as in a run without a clock."""

    def __init__(self, ring: Ring, command: Sequence[str] | None, rig: Rig) -> None:
        """Start the guardian; `rig` is what the front makes safe where the guardian cannot."""
        self._ring = ring
        self._rig = rig
        self._process = None if command is None else _spawn([*command, str(ring.path)])

    def look(self) -> None:
        """Look whether the guardian lives; if not, tell the loop, which stops within a few ticks.

        The loop itself notices a frozen guardian, by its heartbeat.
        """
        if self._process and self._process.poll() is not None:
            self._ring.guardian_lost = 1

    @property
    def pid(self) -> int | None:
        """The guardian's process, where there is one."""
        return None if self._process is None else self._process.pid

    def judge_ending(self, ending: Ending) -> Ending:
        """Return how the run of an ended loop ended, including the valve's state."""
        if not self._process:
            return ending
        report = _read_report(self._process)
        if not report:
            self._process.kill()
            return self._stand_in(ending)
        words = json.loads(report)
        return _ending_of_takeover(Takeover(**words), ending) if words else ending

    def dismiss(self) -> None:
        """Wait for the guardian to leave, once the loop's last event is in the ring."""
        if self._process:
            try:
                self._process.wait(_LEAVE_PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
            self._process.communicate()

    def _stand_in(self, ending: Ending) -> Ending:
        """Make the rig safe in the guardian's place."""
        failure = drive_safe(self._rig)
        if failure is not None:
            return Ending(_worse_code(ending), _alarm_text(ending.reason, str(failure)))
        return ending


def _spawn(command: Sequence[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0)


def _read_report(guardian: subprocess.Popen[bytes]) -> bytes:
    """Return the guardian's last line; empty where it wrote none."""
    assert guardian.stdout
    heard, _, _ = select.select([guardian.stdout], [], [], _REPORT_PATIENCE_S)
    return guardian.stdout.readline() if heard else b""


def _ending_of_takeover(takeover: Takeover, ending: Ending) -> Ending:
    reason = takeover.reason or ending.reason
    if takeover.failure:
        return Ending(_worse_code(ending), _alarm_text(reason, takeover.failure))
    done = f"the guardian drove the safe voltage {takeover.latency_ms:.1f} ms later"
    return Ending(ExitCode.UNEXPECTED, f"{reason}; {done}")


def _worse_code(ending: Ending) -> ExitCode:
    """An output that is not safe is never a success."""
    return ending.code or ExitCode.UNEXPECTED


def _alarm_text(reason: str, failure: str) -> str:
    return (
        f"{reason}; THE SAFE VOLTAGE COULD NOT BE DRIVEN ({failure}): "
        "cut the air supply, then try `pamctl safe`"
    )
