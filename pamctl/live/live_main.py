"""What `--live` starts: `python -m pamctl.live.live_main PORT --socket|--ring PATH ORIGIN...`.

Its standard input is a pipe that ends with the process that started it. Any error is one line on
standard error: the run goes on.
"""

from __future__ import annotations

import os
import select
import sys
from pathlib import Path
from typing import NoReturn

from pamctl.live.feed import DaemonFeed, Feed, RingFeed
from pamctl.recording.ring import Ring

_NICE = 10
"""A viewer gives way to the loop."""


def main() -> NoReturn:
    """Serve until standard input ends."""
    os.nice(_NICE)
    port, kind, source, origins = int(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), sys.argv[4:]
    sys.stdout = sys.stderr  # standard output is the result of the run
    try:
        from pamctl.live.foxglove import EVERY, serve_foxglove

        feed: Feed = (
            DaemonFeed(source, EVERY) if kind == "--socket" else RingFeed(Ring.watch(source), EVERY)
        )
        serve_foxglove(feed, port, origins, _sleep_while_open)
    except Exception as error:
        print(f"live: not served on port {port}: {error}", file=sys.stderr)
        sys.exit(1)
    sys.exit(0)


def _sleep_while_open(seconds: float) -> bool:
    """Sleep; return whether standard input is still open."""
    return not select.select([sys.stdin.fileno()], [], [], seconds)[0]


if __name__ == "__main__":
    main()
