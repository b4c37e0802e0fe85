"""Put a finished log into the index of its folder, in a process that delays nobody.

`python -m pamctl.runs.index_finished LOG`

The daemon goes on watching a rig: it must not read logs itself. A log that is missed here, for
example because the PC went down, is indexed by the next `pamctl runs`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

from hal.child import child_command

INDEX_NAME = ".pamctl-runs.jsonl"
_LEAST_URGENT = 19


def index_in_own_process(log: Path) -> None:
    """Start the process; never wait for it, and never fail."""
    command = child_command("pamctl.runs.index_finished", log)

    def run() -> None:
        with suppress(OSError):
            subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )

    threading.Thread(target=run, name="index", daemon=True).start()


def index_quietly(log: Path, *, make_index: bool = True) -> None:
    """Put a log into the index; no trouble with the index is a trouble of the run.

    Without `make_index` only into one that is there: a log may lie anywhere, such as in /tmp.
    """
    with suppress(Exception):
        if make_index or log.absolute().with_name(INDEX_NAME).exists():
            from pamctl.runs.run_index import append_rows  # slow imports: not before the run
            from pamctl.runs.run_row import read_row

            append_rows(log.absolute().parent, [read_row(log)])


if __name__ == "__main__":
    with suppress(OSError):
        os.nice(_LEAST_URGENT)
    index_quietly(Path(sys.argv[1]))
