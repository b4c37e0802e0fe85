"""Driving the safe voltage again and again, while a dying process may still hold the output."""

from __future__ import annotations

import time
from collections.abc import Callable

# Shorter than the heartbeat: a loop that tries for longer is killed, and its reason is lost. The
# guardian goes on trying.
_TRIES = 6
_TRIES_AS_OPEN = 2
_RETRY_S = 5e-3


def drive_with_retries(
    drive: Callable[[bool], None], is_hopeless: Callable[[Exception], bool]
) -> Exception | None:
    """Call `drive` until it succeeds; return why the last try failed, or None.

    `drive` is told whether to use the device as it is open: after two failures it takes the
    output anew.
    """
    failure: Exception | None = None
    for attempt in range(_TRIES):
        try:
            drive(attempt < _TRIES_AS_OPEN)
        # Any exception at all: the next try is worth more than the reason.
        except Exception as error:
            failure = error
            if is_hopeless(error):
                break
            time.sleep(_RETRY_S)
        else:
            return None
    return failure
