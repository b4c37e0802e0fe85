"""A word while a verb is silent: on a terminal, the seconds that it has worked so far."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_FIRST_S = 1.0
"""A verb that answers sooner needs no word (s)."""
_CLEAR = "\r\x1b[K"

SLOW_VERBS = {
    "start": "homing, if the muscle is not homed",
    "goto": "homing, if the muscle is not homed",
    "audit": "simulating and judging",
    "compare": "simulating",
    "replay": "reading and computing every tick",
    "report": "reading and drawing",
    "tune": "compiling and drawing plants",
}
"""Verbs that may be silent for seconds, and what they do then."""


@contextmanager
def tell_while_silent(verb: str) -> Iterator[Callable[[], None]]:
    """Show on standard error what a slow verb does, until it prints or ends.

    Gives the function to call before the verb prints anything. Without a terminal nothing is shown.
    """
    if verb not in SLOW_VERBS or sys.stderr is None or not sys.stderr.isatty():
        yield lambda: None
        return
    ended, shown = threading.Event(), threading.Lock()

    def show_seconds() -> None:
        seconds = _FIRST_S
        while not ended.wait(1.0):
            with shown:
                if not ended.is_set():
                    _write(f"{_CLEAR}{verb}: {SLOW_VERBS[verb]}, {seconds:.0f} s")
            seconds += 1.0

    def end() -> None:
        if not ended.is_set():
            with shown:
                ended.set()
                _write(_CLEAR)

    teller = threading.Thread(target=show_seconds, name="waiting", daemon=True)
    teller.start()
    try:
        yield end
    finally:
        end()


def _write(text: str) -> None:
    """Write past Python's buffer, whose lock a worker process would inherit."""
    os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, text.encode())
