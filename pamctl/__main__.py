"""`pamctl` and `python -m pamctl`."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main() -> None:
    """Run the command line; Ctrl-C is an exit code, never a traceback."""
    # A closed stream would hand its number to the next file opened.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
    try:
        _import_all()
        from pamctl.cli.app import app
        from pamctl.realtime.scheduling import keep_single_threaded

        # The algebra here is small: threads of numpy would mostly wait for each other, and take
        # a CPU from a loop or another worker. This also holds for all processes started from
        # here; each starts with 0.1 s of CPU less.
        keep_single_threaded()
        app()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        # The reader has gone, as `head` does. Python flushes at its end: to nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _import_all() -> None:
    """Import the command line: half of the start-up, so an early Ctrl-C is likely to come here.

    A `KeyboardInterrupt` while a class is built would become another error.
    """
    may_interrupt = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if may_interrupt:
        signal.signal(signal.SIGINT, _leave_at_once)
    import pamctl.cli.app  # noqa: F401

    if may_interrupt:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave_at_once(number: int, frame: FrameType | None) -> None:
    """Leave: nothing has begun yet."""
    os._exit(130)


if __name__ == "__main__":
    main()
