"""The rig of a running daemon, steered through its control socket."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pamctl.daemon.client import Client, DaemonDeclinedError, default_socket
from pamctl.exit_codes import ExitCode
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.steered_rig import InterruptedWaitError, SteeredRig
from pamctl.signals import Phase

_LOOK_EVERY_S = 0.05
_STOP_PATIENCE_S = 30.0
_SAME_M = 1e-9


def connect(socket: str | Path | None = None) -> DaemonRig:
    """Connect to a running daemon; `socket` is its control socket [default: as `pamctl status`].

    Raises `PamctlError` with exit code 69 where no daemon answers.
    """
    with translate_errors():
        return DaemonRig(Path(socket) if socket is not None else default_socket())


class DaemonRig(SteeredRig):
    """A client of the daemon.

    When it is closed it stops the run or the held position that was begun here: the valve goes to
    the safe voltage on the stop's ramp, and the muscle stays homed. Runs of other clients go on.
    If this process is killed, the daemon finishes the run by itself.
    """

    def __init__(self, socket: Path) -> None:
        """Connect; raise `DaemonUnreachableError`."""
        self._socket = socket
        self._client: Client | None = Client(socket)
        self._own_log: Path | None = None
        self._is_beginning = False
        self._interrupted = threading.Event()
        self._is_open = True
        self.status()

    def _ask(self, method: str, **params: object) -> Any:
        if not self._is_open:
            raise PamctlError("this connection is closed; connect again", ExitCode.USAGE)
        with translate_errors():
            client = self._client = self._client or Client(self._socket)
            try:
                return client.call(method, params)
            except DaemonDeclinedError:
                raise
            except BaseException:
                # Its answer may still come: another request needs another connection.
                self._client = None
                client.close()
                raise

    def _begin(self, method: str, **params: object) -> str:
        """Ask for a motion, and return its log. Ctrl-C may come before the answer does."""
        self._is_beginning = True
        try:
            log = str(self._ask(method, **params)["log"])
        except PamctlError:
            self._is_beginning = False
            raise
        self._own_log, self._is_beginning = Path(log), False
        return log

    def status(self) -> dict[str, Any]:
        """Return the daemon's status."""
        answer: dict[str, Any] = self._ask("status")
        return answer

    def settings(self) -> dict[str, Any]:
        """Return the settings that the daemon was started with, and its gains."""
        answer: dict[str, Any] = self._ask("settings")
        return answer

    def mark(self, text: str) -> None:
        """Put a remark into the log of the current run."""
        self._ask("mark", text=text)

    def stop(self) -> None:
        """End the current run smoothly; return when its log is whole."""
        self._ask("stop")
        self._await_over(self.status()["log"])

    def disarm(self) -> None:
        """End the session smoothly; the next run homes again."""
        self._ask("disarm")

    def estop(self) -> None:
        """Drive the safe voltage at once; on a connection of its own, which waits for nobody."""
        with translate_errors(), Client(self._socket) as client:
            client.call("estop")

    def ack(self) -> str:
        """Acknowledge a fault; return what it was."""
        # The loop may still be ending: then the daemon asks for another try.
        self._look_until(lambda status: not status["pids"], _STOP_PATIENCE_S)
        return str(self._ask("ack")["fault"])

    def sleep(self, duration_s: float) -> None:
        """Wait for some seconds of the clock."""
        if self._interrupted.wait(duration_s):
            self._raise_interrupt()

    def live(
        self, rate_hz: float = 50.0, *, duration_s: float | None = None
    ) -> Iterator[Mapping[str, float]]:
        """Yield the newest ticks in order, until the run ends."""
        status = self._require_well(self.status())
        every = max(1, round(status["rate_hz"] / rate_hz))
        newest = -1 if status["tick"] is None else int(status["tick"]["tick"])
        left = math.inf if duration_s is None else round(duration_s * status["rate_hz"] / every)
        while left > 0:
            goes_on = self._require_well(self.status())["run"] is not None
            columns = self._ask("recent", after_tick=newest, every=every)
            for values in columns["ticks"]:
                tick = dict(zip(columns["fields"], map(_nan_if_none, values), strict=True))
                newest = int(tick["tick"])
                yield tick
                left -= 1
                if left <= 0:
                    return
            if not goes_on:
                return
            self.sleep(_LOOK_EVERY_S)

    def interrupt(self) -> None:
        """End what waits in another thread."""
        self._interrupted.set()

    def close(self) -> None:
        """Stop what was begun here, and hang up."""
        if not self._is_open:
            return
        self._interrupted.clear()
        try:
            self._stop_own_run()
        finally:
            self._is_open = False
            if self._client is not None:
                self._client.close()

    def _start(self, data: dict[str, Any], name: str, duration_s: float | None) -> Path:
        asked = {"experiment": data, "name": name, "duration_s": duration_s}
        return Path(self._begin("start", **asked))

    def _goto(self, position_m: float, within_s: float | None) -> None:
        log = self._begin("goto", position_m=position_m, within_s=within_s)

        def has_arrived(status: Mapping[str, Any]) -> bool:
            tick = self._require_well(status)["tick"]
            if status["log"] != log:
                raise PamctlError("the motion was stopped", ExitCode.CHECK_FAILED, Path(log))
            # Until the first tick of the motion, the newest tick is of the position before it.
            return (
                tick is not None
                and tick["phase"] == Phase.REST
                and abs(_nan_if_none(tick["reference_m"]) - position_m) < _SAME_M
            )

        self._look_until(has_arrived)

    def _change_gains(self, changes: list[str], ramp_s: float) -> dict[str, Any]:
        gains: dict[str, Any] = self._ask("set", changes=changes, ramp_s=float(ramp_s))
        return gains

    def _load_gains(self, data: dict[str, Any], name: str, ramp_s: float) -> dict[str, Any]:
        gains: dict[str, Any] = self._ask("load", controller=data, name=name, ramp_s=float(ramp_s))
        return gains

    def _wait_for_end(self) -> Path:
        log = self._own_log
        if log is None:
            raise PamctlError("no run was begun here; begin one with start()", ExitCode.USAGE)
        status = self._await_over(str(log))
        self._require_well(status, log)
        return log

    def _await_over(self, log: str | None) -> Mapping[str, Any]:
        """Return the status once this log is whole."""
        return self._look_until(lambda status: log is None or status["log"] != log)

    def _look_until(
        self, holds: Callable[[Mapping[str, Any]], bool], patience_s: float = math.inf
    ) -> Mapping[str, Any]:
        deadline_s = time.monotonic() + patience_s
        while not holds(status := self.status()) and time.monotonic() < deadline_s:
            self.sleep(_LOOK_EVERY_S)
        return status

    def _require_well(
        self, status: Mapping[str, Any], log: Path | None = None
    ) -> Mapping[str, Any]:
        """Raise the fault that the daemon has latched."""
        if not status["fault"]:
            return status
        faults = [event for event in status["events"] if event["event"] == "fault"]
        code = ExitCode(faults[-1]["code"]) if faults else ExitCode.SAFETY_TRIP
        raise PamctlError(f"{status['fault']}; acknowledge it with ack()", code, log)

    def _stop_own_run(self) -> None:
        log = None if self._own_log is None else str(self._own_log)
        if not self._is_beginning and (log is None or self.status()["log"] != log):
            return
        # The daemon carries out one order after the other: a motion that was just asked for has
        # begun when it comes to this one.
        self._is_beginning = False
        try:
            self._ask("stop")
        except PamctlError as error:
            if not isinstance(error.__cause__, DaemonDeclinedError):
                raise
            return  # it has just ended by itself
        log = self.status()["log"]
        self._look_until(lambda status: log is None or status["log"] != log, _STOP_PATIENCE_S)

    def _raise_interrupt(self) -> None:
        self._interrupted.clear()
        raise InterruptedWaitError


def _nan_if_none(value: float | None) -> float:
    return math.nan if value is None else value
