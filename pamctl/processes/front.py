"""The tree of processes of one loop, and the front, which starts it and finishes what it leaves.

    front - guardian
          - loop
          - recorder  one for each run

A run of `pamctl run` has a tree of its own; a daemon's loop outlives its runs, as
`daemon/session.py` has it. Each child sees the front's death as the end of a pipe. Ctrl-C reaches
the front only, which passes it on to the loop only.

The guardian takes over from a loop that dies or freezes. If the guardian dies or freezes too, the
front takes over: it kills a silent loop and drives the safe voltage. The front waits a little
longer than the guardian, so that only one of them acts where both live.
"""

from __future__ import annotations

import json
import select
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from types import FrameType

from hal.child import child_command
from hal.rig import Rig
from pamctl.base.errors import Ending, ExitCode
from pamctl.processes.guardian import POLL_MS, Silence, Takeover, read_state, take_over
from pamctl.processes.interrupts import STOP_SIGNALS, block_signals
from pamctl.realtime.clock import LoopSettings
from pamctl.realtime.scheduling import Mode, raise_front_priority
from pamctl.recording.journal import put_event_for_dead_loop
from pamctl.recording.recorded_run import LogReport, ProcessRecordedRun
from pamctl.recording.ring import Ring

_SHOW_EVERY_S = 0.05

Progress = Callable[[Mapping[str, float], float], None]
"""Called with the newest tick's columns and the worst lateness (s) so far."""


class LoopTree:
    """A loop process, its guardian, and the run that is recorded now."""

    def __init__(
        self, ring: Ring, rig: Rig, pace: LoopSettings, run: ProcessRecordedRun | None = None
    ) -> None:
        """Start the loop of `run` on its ring; without a run, the loop of a session.

        `rig` is not open: it is made safe where neither loop nor guardian is left to do it. `pace`
        says how long the loop may be silent.
        """
        self.run = run
        words = [ring.path, *(["session"] if run is None else [])]
        # The loop inherits the block and lifts it when it has handlers: a signal that comes while
        # it starts waits, instead of killing it.
        with block_signals():
            guardian = _spawn("pamctl.processes.guardian_main", ring.path)
            self._loop = _spawn("pamctl.processes.loop_main", *words)
            self._guardian = Guardianship(ring, guardian, rig, pace)
            ring.loop_pid = self._loop.pid

    @property
    def is_alive(self) -> bool:
        """The loop process lives."""
        return self._loop.poll() is None

    def send_signal(self, number: int, frame: FrameType | None = None) -> None:
        """Pass a signal on to the loop if it lives; also as a handler of the signal."""
        if self.is_alive:
            self._loop.send_signal(number)

    def look(self) -> None:
        """See whether guardian, loop and recorder live; call it every `LOOK_EVERY_S`."""
        self._guardian.look(self._loop)
        if self.run is not None:
            self.run.look()

    def conclude(self, failing: str = "") -> tuple[Ending, LogReport | None]:
        """Return how a dead loop ended, and what became of the log of its run.

        The valve is safe afterwards. `failing` says why the loop was killed, if it was.
        """
        ending = _read_ending(self._loop)
        ending = self._guardian.judge_ending(ending._replace(reason=failing or ending.reason))
        try:
            return ending, None if self.run is None else self.run.finish(ending)
        finally:
            # Only now: if the front dies here, the guardian finishes the log.
            self._guardian.dismiss()


def conduct_run(
    ring: Ring, rig: Rig, progress: Progress, mode: Mode, pace: LoopSettings
) -> LogReport:
    """Run the loop on a fresh ring to its end; return when the log is on disk.

    Takes over the signals that end a run, and leaves them without effect: call it within
    `restore_signals`. `mode` is for this process alone: it says whether the front may be scheduled
    in real time while it watches. For `rig` and `pace` see `LoopTree`.
    """
    with block_signals():
        tree = LoopTree(ring, rig, pace, ProcessRecordedRun("run", ring))
        for number in STOP_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # ignored under nohup
                signal.signal(number, tree.send_signal)
    shown_s = 0.0
    with raise_front_priority(mode):
        while tree.is_alive:
            tree.look()
            now_s = time.monotonic()
            if now_s - shown_s >= _SHOW_EVERY_S and (tick := ring.latest_tick()) is not None:
                shown_s = now_s
                progress(tick, ring.worst_late_ns * 1e-9)
            time.sleep(LOOK_EVERY_S)
    _, report = tree.conclude()
    assert report is not None
    return report


def _spawn(module: str, *arguments: object) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        child_command(module, *arguments),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        process_group=0,
    )


def _read_ending(loop: subprocess.Popen[bytes]) -> Ending:
    """Return what a dead loop process said last, or how it died."""
    said, _ = loop.communicate()
    try:
        report = json.loads(said.splitlines()[-1])
        return Ending(ExitCode(report["code"]), report["reason"])
    except (ValueError, KeyError, TypeError, IndexError):
        code = loop.returncode
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"left with {code}"
        return Ending(ExitCode.UNEXPECTED, f"the loop process {how}")


# --- the guardian, as the front sees it ---------------------------------------------------------

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
        if self._reason:  # a loop that is killed may wait for a CPU to die on
            return
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
