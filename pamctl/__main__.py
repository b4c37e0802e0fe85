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
        from pamctl.cli.failure import document_failures
        from pamctl.realtime.scheduling import keep_single_threaded

        # The algebra here is small: threads wait for each other more than they work, and would
        # take from a loop, or from other workers, a second CPU for nothing. In all processes that
        # are started from here, too; the start alone of each takes 0.1 s of CPU less.
        keep_single_threaded()
        with document_failures(sys.argv[1:]):
            app()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        # The reader has gone, as `head` does; what is left to flush has no reader either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _import_all() -> None:
    """Import the command line: half of the start-up, into which an impatient Ctrl-C falls.

    Python makes other errors of a `KeyboardInterrupt` that comes while a class is built.
    """
    may_interrupt = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if may_interrupt:
        signal.signal(signal.SIGINT, _leave_at_once)
    import pamctl.cli.app  # noqa: F401

    if may_interrupt:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave_at_once(number: int, frame: FrameType | None) -> None:
    """Nothing has begun that would have to be ended."""
    os._exit(130)


if __name__ == "__main__":
    main()
