"""Finish the logs of runs that died with all their processes, and say so on standard error.

`python -m pamctl.recording.orphans DIRECTORY` does it in a process of its own, for whoever goes on
watching over a rig: what it takes in memory ends with that process.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def finish_orphans(directory: Path, *, quiet: bool) -> None:
    """Finish the logs whose rings are still in `directory`."""
    if not _has_rings(directory):
        return
    from pamctl.recording.finish_from_ring import recover_orphans

    for orphan in recover_orphans(directory):
        if not quiet:
            done = orphan.recovery and f"finished {orphan.recovery.destination}"
            what = done or f"could not finish its log: {orphan.problem}"
            print(f"a run died before ({orphan.ring}): {what}", file=sys.stderr)


def finish_orphans_in_own_process(directory: Path) -> None:
    """Have a process of its own do it. What it leaves undone, the next start finds again."""
    if _has_rings(directory):
        command = [sys.executable, "-m", "pamctl.recording.orphans", str(directory)]
        subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def _has_rings(directory: Path) -> bool:
    return any(directory.glob("pamctl-*.ring"))


if __name__ == "__main__":
    finish_orphans(Path(sys.argv[1]), quiet=False)
