"""The watchman: `python -m pamctl.processes.watchman_main`, started by `doctor` and `calibrate`.

They drive the valve from the process that talks to a person, and a card holds its last voltage
when that process is killed. So the watchman waits for the death of that process, which the end
of a pipe reports at once, and then drives the safe voltage. A line on the pipe says that the work
ended well and that there is nothing to do.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from hal.child import child_command
from hal.rig import Rig, RigError
from pamctl.exit_codes import ExitCode
from pamctl.processes.backends import build_clock, build_rig, require_backend
from pamctl.processes.guardian import drive_safe
from pamctl.recording.recorder import outlive_signals
from pamctl.settings.resolve import RunSettings, from_resolved, settings_to_json

_ALL_WELL = b"all is well\n"


@contextmanager
def keep_watchman(settings: RunSettings, rig: Rig) -> Iterator[None]:
    """Keep a watchman for the block; it makes the rig safe if this process dies in it.

    The block closes the rig. Raises `RigError` where the watchman cannot work, or where neither
    the block nor the watchman could make the rig safe.
    """
    watchman = subprocess.Popen(
        child_command("pamctl.processes.watchman_main"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    assert watchman.stdin is not None
    assert watchman.stdout is not None
    try:
        with suppress(BrokenPipeError):
            watchman.stdin.write(json.dumps(settings_to_json(settings)).encode() + b"\n")
            watchman.stdin.flush()
        if watchman.stdout.readline() != b"ready\n":
            raise RigError("the watchman process did not start", fix="see its message above")
        yield
    finally:
        with suppress(BrokenPipeError):
            if rig.safe_failure is None:
                watchman.stdin.write(_ALL_WELL)
            watchman.stdin.close()
        watchman.wait()
        watchman.stdout.close()
    if rig.safe_failure is not None:
        raise rig.safe_failure


def main() -> int:
    """Wait for the end of standard input; make the rig safe unless all is well."""
    outlive_signals()
    settings = from_resolved(json.loads(sys.stdin.buffer.readline()))
    try:
        # Loaded now, because it costs a fraction of a second.
        require_backend(settings)
    except RigError as error:
        print(f"watchman: {error}", file=sys.stderr)
        return int(ExitCode.UNAVAILABLE)
    rig = build_rig(settings, build_clock(settings, may_spin=False)).rig
    os.write(sys.stdout.fileno(), b"ready\n")
    if sys.stdin.buffer.readline() == _ALL_WELL:
        return int(ExitCode.OK)
    failure = drive_safe(rig)
    return int(ExitCode.OK if failure is None else ExitCode.UNAVAILABLE)


if __name__ == "__main__":
    sys.exit(main())
