"""The person at the terminal: asked on standard error, answering on standard input.

The rig goes on while an answer is awaited: `idle` is called again and again, and holds a pressure
or watches the encoder.
"""

from __future__ import annotations

import math
import os
import select
import sys
from collections.abc import Callable


class NoAnswer(Exception):
    """Standard input has ended, or the person said no."""


class Terminal:
    """Asks a person, and keeps the rig running while waiting."""

    def __init__(self) -> None:
        """Read lines from standard input as they come."""
        self._buffer = b""

    def say(self, text: str) -> None:
        """Print a remark on standard error; standard output is for results."""
        print(text, file=sys.stderr, flush=True)

    def wait(self, request: str, idle: Callable[[], object]) -> None:
        """Ask for something to be done, and wait for Enter. Raises `NoAnswer`."""
        self._line(f"{request} [Enter]", idle)

    def confirm_done(self, request: str, idle: Callable[[], object]) -> bool:
        """Ask for something to be done; return whether it was. Raises `NoAnswer`."""
        return not self._line(f"{request} [Enter, or s to skip]", idle).lower().startswith("s")

    def number(self, question: str, idle: Callable[[], object]) -> float:
        """Ask for a number until one is given. Raises `NoAnswer`."""
        while True:
            text = self._line(question, idle)
            try:
                value = float(text.replace(",", "."))
            except ValueError:
                value = math.nan
            if math.isfinite(value):
                return value
            self.say(f"'{text}' is not a number")

    def require_yes(self, question: str) -> None:
        """Ask for a yes; raise `NoAnswer` on anything else."""
        if self._line(f"{question} [y/N]", None).lower() not in {"y", "yes"}:
            raise NoAnswer("not confirmed")

    def _line(self, question: str, idle: Callable[[], object] | None) -> str:
        source = sys.stdin.fileno()
        print(f"{question} ", end="", file=sys.stderr, flush=True)
        while b"\n" not in self._buffer:
            if idle is not None:
                idle()
            if select.select([source], [], [], None if idle is None else 0.0)[0]:
                # Without Python's buffer: `select` would not see a second line in it.
                read = os.read(source, 4096)
                if not read:
                    raise NoAnswer("standard input has ended; give the values by options")
                self._buffer += read
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode(errors="replace").strip()
