"""Keep the PC awake while a valve depends on it: a card holds its last voltage while the PC sleeps.

logind keeps a PC awake for whoever holds an inhibitor; `systemd-inhibit` holds one until the
command that it runs ends. That command is `cat`, which ends with its input, and so with us.
"""

from __future__ import annotations

import os
import select
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
