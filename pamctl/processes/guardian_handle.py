"""The front's side of the guardian: start it, replace it when it fails, ask what it did.

The guardian takes over from a loop that dies or freezes. If the guardian dies or freezes too,
the front takes over: it kills a silent loop and drives the safe voltage. The front waits a
little longer than the guardian, so that only one of them acts where both live.
"""

from __future__ import annotations

import json
import select
import subprocess
import time

from hal.rig import Rig
from pamctl.exit_codes import Ending, ExitCode
from pamctl.processes.guardian import POLL_MS, Silence, Takeover, read_state, take_over
from pamctl.realtime.clock import LoopSettings
from pamctl.recording.journal import put_event_for_dead_loop
from pamctl.recording.ring import Ring

LOOK_EVERY_S = POLL_MS * 1e-3
"""How often the owner of a `Guardianship` calls `look`."""
_LEAD_NS = 40_000_000
"""The guardian's lead: the front kills a loop that is silent for this much longer."""
_HEAD_START_S = 0.05
"""The front drives the safe voltage itself if the guardian takes longer to report."""
_REPORT_PATIENCE_S = 1.0
_LEAVE_PATIENCE_S = 2.0


class Guardianship:
    """The guardian of one loop."""

    def __init__(
        self, ring: Ring, process: subprocess.Popen[bytes], rig: Rig, pace: LoopSettings
    ) -> None:
        """`process` is the guardian; its input and output are pipes.

        `rig` is not open: the front makes it safe where nobody else can. `pace` says how long
        a loop may be silent: then the guardian kills it, and the front a little later.
        """
        self._ring = ring
        self._rig = rig
        self._pace = pace
        self._process = process
        self._silence: Silence | None = None
        self._reason = ""

    def look(self, loop: subprocess.Popen[bytes]) -> None:
        """See whether guardian and loop live; call it every `LOOK_EVERY_S`.

        A loop that lives stops by itself when its guardian is gone or frozen. A loop that is
        frozen cannot: it is killed here if the guardian has not done it.
        """
        if self._process.poll() is not None:
            self._ring.guardian_lost = 1
        if self._silence is None:
            beat_ns, starved_ns = (
                round(ms * 1e6) for ms in (self._pace.heartbeat_ms, self._pace.starved_ms)
            )
            self._silence = Silence(self._ring, loop.pid, beat_ns, starved_ns, _LEAD_NS)
        fault = self._silence.find_fault()
        if fault and loop.poll() is None:
            self._reason = f"{fault}, its guardian did nothing, and the front killed it"
            loop.kill()

    def judge_ending(self, ending: Ending) -> Ending:
        """Return how the run of a dead loop ended, the valve included.

        A loop that had to be killed while it released its device has told its ending before.
        """
        if self._reason:
            ending = ending._replace(reason=_join_reasons(ending, self._reason))
        noticed_ns = time.monotonic_ns()
        report = self._await_report(self._process)
        if not report:
            self._process.kill()
            return self._take_over(ending, noticed_ns)
        words = json.loads(report)
        return _ending_of_takeover(Takeover(**words), ending) if words else ending

    def dismiss(self) -> None:
        """Let the guardian leave, once the log is finished: it would finish it otherwise."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.close()
        try:
            self._process.wait(_LEAVE_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def _await_report(self, guardian: subprocess.Popen[bytes]) -> bytes:
        """Return the guardian's last line; nothing if it is dead or frozen.

        The valve does not wait for words: after a head start the front writes the safe voltage
        as well. A card may refuse it while the guardian holds the output; then the guardian
        lives, or its death below sets the output free.
        """
        assert guardian.stdout
        began_s = time.monotonic()
        is_safe = False
        while (waited_s := time.monotonic() - began_s) < _REPORT_PATIENCE_S:
            if select.select([guardian.stdout], [], [], LOOK_EVERY_S)[0]:
                return guardian.stdout.readline()
            if read_state(guardian.pid) in {"T", "t"}:  # a signal or a debugger stopped it
                return b""
            if waited_s > _HEAD_START_S and not is_safe:
                self._rig.make_safe()
                is_safe = self._rig.safe_failure is None
        return b""

    def _take_over(self, ending: Ending, noticed_ns: int) -> Ending:
        """Do what the guardian cannot do any more."""
        takeover = take_over(self._ring, self._rig, self._reason, noticed_ns)
        if takeover is None:
            return ending
        put_event_for_dead_loop(self._ring, {**takeover.event(), "event": "front_takeover"})
        return _ending_of_takeover(takeover, ending, "the front")


def _ending_of_takeover(takeover: Takeover, ending: Ending, who: str = "the guardian") -> Ending:
    # The front's own reason is in the ending already.
    fault = "" if takeover.reason in ending.reason else takeover.reason
    reason = _join_reasons(ending, fault)
    code = ending.code or ExitCode.UNEXPECTED  # a loop that leaves its valve is no success
    if takeover.failure:
        return Ending(code, _alarm_text(reason, takeover.failure))
    done = f"{who} drove the safe voltage {takeover.latency_ms:.1f} ms later"
    return Ending(code, f"{reason}; {done}")


def _join_reasons(ending: Ending, fault: str) -> str:
    """Return why a run ended: what the loop told of itself, then the fault it was killed for."""
    has_told = ending.code not in (ExitCode.OK, ExitCode.UNEXPECTED)
    return "; ".join(filter(None, (ending.reason, fault))) if has_told else fault or ending.reason


def _alarm_text(reason: str, failure: str) -> str:
    return (
        f"{reason}; THE SAFE VOLTAGE COULD NOT BE DRIVEN ({failure}): "
        "cut the air supply, then try `pamctl safe`"
    )
