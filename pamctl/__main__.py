"""`pamctl` and `python -m pamctl`."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; Ctrl-C is an exit code, never a traceback."""
    try:
        # Half of the start-up is this import, and an impatient Ctrl-C falls into it.
        from pamctl.cli.app import app

        app()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
