"""A word while a verb is silent: on a terminal, the seconds that it has worked so far."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_FIRST_S = 0.7
"""A verb that answers sooner needs no word (s)."""
_BEGAN_S = time.monotonic()
"""The program's start: this is imported first."""
_CLEAR = "\r\x1b[K"

STARTING = "pamctl: starting"


@contextmanager
def tell_while_silent(doing: str | None) -> Iterator[Callable[[], None]]:
    """Show on standard error what is being done, until something is printed or it ends.

    Gives the function to call before anything is printed. Without a terminal, or with None,
    nothing is shown.
    """
    if doing is None or sys.stderr is None or not sys.stderr.isatty():
        yield lambda: None
        return
    ended, shown, told = threading.Event(), threading.Lock(), threading.Event()

    def show_seconds() -> None:
        next_s = max(_FIRST_S, time.monotonic() - _BEGAN_S)
        while not ended.wait(max(0.0, _BEGAN_S + next_s - time.monotonic())):
            with shown:
                if not ended.is_set():
                    told.set()
                    _write(f"{_CLEAR}{doing}{_tell_compiling()}, {next_s:.0f} s")
            next_s = round(next_s) + 1.0

    def end() -> None:
        if not ended.is_set():
            with shown:
                ended.set()
                if told.is_set():
                    _write(_CLEAR)

    teller = threading.Thread(target=show_seconds, name="waiting", daemon=True)
    teller.start()
    try:
        yield end
    finally:
        end()
        teller.join()


def _tell_compiling() -> str:
    build = sys.modules.get("pamctl.kernel.build")  # most verbs do without
    is_first = build is not None and build.progress.builds
    return " (the first time after an update the model is compiled)" if is_first else ""


def _write(text: str) -> None:
    """Write past Python's buffer, whose lock a worker process would inherit."""
    os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, text.encode())
