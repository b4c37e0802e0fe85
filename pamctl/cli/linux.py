"""What drives a rig, or talks to what does, needs Linux; the verbs that read logs do not."""

from __future__ import annotations

import sys

from pamctl.cli.failure import fail
from pamctl.exit_codes import ExitCode


def require_linux() -> None:
    """Leave with 69 elsewhere, before anything is imported that is not there."""
    if sys.platform != "linux":
        elsewhere = "the verbs that read logs, and config, reproduce and tune, work here too"
        fail(ExitCode.UNAVAILABLE, f"this verb needs Linux; {elsewhere}")
