"""Finish the logs of runs whose processes all died, and report it on standard error.

`python -m pamctl.recording.orphans DIRECTORY` does this in a separate process. A caller that goes
on watching a rig gets the memory back when that process ends.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from hal.child import child_command


def finish_orphans(directory: Path, *, quiet: bool) -> None:
    """Finish the logs whose rings are in `directory`."""
    if not _has_rings(directory):
        return
    from pamctl.recording.finish_from_ring import recover_orphans

    for orphan in recover_orphans(directory):
        if not quiet:
            done = orphan.recovery and f"finished {orphan.recovery.destination}"
            what = done or f"cannot finish its log: {orphan.problem}"
            print(f"an earlier run died ({orphan.ring}): {what}", file=sys.stderr)


def finish_orphans_in_own_process(directory: Path) -> None:
    """Finish them in a separate process. The next start finds those that it could not finish."""
    if _has_rings(directory):
        command = child_command("pamctl.recording.orphans", directory)
        subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def _has_rings(directory: Path) -> bool:
    return any(directory.glob("pamctl-*.ring"))


if __name__ == "__main__":
    finish_orphans(Path(sys.argv[1]), quiet=False)
