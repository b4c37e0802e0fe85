"""What must not cut a run short while a valve depends on it: signals, and the sleep of the PC.

The first signal ends a run, or a person's work on the rig, in good order.

A card holds its last voltage while the PC sleeps. logind keeps a PC awake for whoever holds an
inhibitor; `systemd-inhibit` holds one until the command that it runs ends. That command is `cat`,
which ends with its input, and so with us.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType, TracebackType

from pamctl.base.errors import ExitCode

STOP_SIGNALS = {
    signal.SIGINT: ExitCode.SIGINT,
    signal.SIGTERM: ExitCode.SIGTERM,
}
if hasattr(signal, "SIGHUP"):  # Windows closes a terminal in other ways
    STOP_SIGNALS[signal.SIGHUP] = ExitCode.SIGHUP


class SignalInterrupt(Exception):
    """A signal ended the work; `code` is the exit code that says so."""

    def __init__(self, number: int) -> None:
        """Keep the signal's number."""
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.code = 128 + number


class Interrupts:
    """Turns the first signal within `heed_signals` into `SignalInterrupt`; others wait.

    So the way out, on which the valve is made safe, always runs to its end. Ctrl-Z is ignored:
    a stopped process would hold the valve open.
    """

    def __init__(self) -> None:
        """Change nothing yet; the block does."""
        self._before: dict[int, object] = {}
        self._heeding = False
        self._pending: int | None = None

    def __enter__(self) -> Interrupts:
        """Take the signals over."""
        for number in STOP_SIGNALS:
            self._before[number] = signal.signal(number, self._note)
        self._before[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, signal.SIG_IGN)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Restore the handlers; raise for a signal that came outside `heed_signals`."""
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        if self._pending is not None and error is None:
            raise SignalInterrupt(self._pending)

    @contextmanager
    def heed_signals(self) -> Iterator[None]:
        """Let a signal end this block."""
        if self._pending is not None:
            raise SignalInterrupt(self._pending)
        self._heeding = True
        try:
            yield
        finally:
            self._heeding = False

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._pending is None:
            self._pending = number
        if self._heeding:
            self._heeding = False
            raise SignalInterrupt(number)


@contextmanager
def block_signals() -> Iterator[None]:
    """Block the signals that end a run; a process that is started within inherits the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def restore_signals() -> Iterator[None]:
    """Restore the handlers of the signals that end a run, unless an exception ends the block.

    The block reports the run as well: a further Ctrl-C, or a closed terminal, must not cut that
    short.
    """
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


# --- sleep --------------------------------------------------------------------------------------

_COMMAND = [
    "systemd-inhibit",
    "--what=sleep:idle:handle-lid-switch",
    "--who=pamctl",
    "--why=a valve is being driven",
    "--mode=block",
    "cat",
]
_ANSWER_S = 2.0
_STATES = Path("/sys/power/state")
_TARGET = Path("/etc/systemd/system/sleep.target")
MASK = "sudo systemctl mask sleep.target suspend.target hibernate.target hybrid-sleep.target"
"""What keeps a PC awake for good."""


class SleepInhibitor:
    """Keeps the PC awake until `release`, or the end of this process, where logind permits it."""

    def __init__(self) -> None:
        """Ask for it; wait for nobody."""
        self._process: subprocess.Popen[bytes] | None = None
        self._problem = ""
        pipe = subprocess.PIPE
        try:
            # Its own process group gets no Ctrl-C.
            self._process = subprocess.Popen(
                _COMMAND, bufsize=0, stdin=pipe, stdout=pipe, stderr=pipe, process_group=0
            )
        except OSError as error:
            self._problem = f"systemd-inhibit: {error.strerror}"

    def explain_refusal(self) -> str:
        """Return why the PC is not kept awake; empty where it is. Waits for logind's answer."""
        if self._process is None:
            return self._problem
        assert self._process.stdin
        assert self._process.stdout
        assert self._process.stderr
        with suppress(BrokenPipeError):
            self._process.stdin.write(b"\n")
        if not select.select([self._process.stdout], [], [], _ANSWER_S)[0]:
            return "systemd-inhibit: logind does not answer"
        if self._process.stdout.read(1):  # `cat` runs, so the inhibitor is held
            return ""
        said = self._process.stderr.read().decode(errors="replace").strip().partition("\n")[0]
        return f"systemd-inhibit: {said or 'it failed'}"

    def release(self) -> None:
        """Let the PC sleep again."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()  # closes the input of `cat`
            self._process = None


def can_sleep() -> bool:
    """Tell whether this PC can be put to sleep: the kernel offers it and nobody has masked it."""
    try:
        states = _STATES.read_text().split()
    except OSError:
        return False
    return bool(states) and os.path.realpath(_TARGET) != os.devnull


def explain_risk(inhibitor: SleepInhibitor) -> str:
    """Return a line for the user where the PC may go to sleep during a run; else nothing."""
    if not can_sleep() or not (why := inhibitor.explain_refusal()):
        return ""
    return f"nothing keeps this PC from going to sleep during a run ({why}); forbid it: {MASK}"


@contextmanager
def keep_awake() -> Iterator[str]:
    """Keep the PC awake within the block; yield a line for the user where that is not possible."""
    inhibitor = SleepInhibitor()
    try:
        yield explain_risk(inhibitor)
    finally:
        inhibitor.release()
