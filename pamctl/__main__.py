"""`pamctl` and `python -m pamctl`."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run the command line; Ctrl-C is an exit code, never a traceback."""
    # A closed stream would hand its number to the next file opened.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
    try:
        # Half of the start-up is this import, and an impatient Ctrl-C falls into it.
        from pamctl.cli.app import app
        from pamctl.cli.failure import documented

        with documented(sys.argv[1:]):
            app()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        # The reader has gone, as `head` does; what is left to flush has no reader either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


if __name__ == "__main__":
    main()
