"""`--live`: a separate process serves the values of a run or a daemon to Foxglove."""

from __future__ import annotations

import importlib.util
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from hal.child import child_command
from pamctl.exit_codes import ExitCode


class LiveViewError(Exception):
    """Live values cannot be served. The message says what is missing."""

    exit_code = ExitCode.UNAVAILABLE


def require_foxglove() -> None:
    """Raise `LiveViewError` where the package that serves live values is not installed."""
    if importlib.util.find_spec("foxglove") is None:
        raise LiveViewError(
            "--live needs foxglove-sdk, which is not installed: "
            "pip install '.[live]' in the checkout of pamctl"
        )


@contextmanager
def serve_live_view(port: int | None, origins: Sequence[str], *source: str) -> Iterator[None]:
    """Let `pamctl.live.live_main` serve `source` on `port` inside the block; None serves nothing.

    Pages of the sites in `origins` may watch, beside programs and applications.
    """
    if port is None:
        yield
        return
    command = child_command("pamctl.live.live_main", port, *source, *origins)
    # Its own process group gets no Ctrl-C. It leaves when its standard input ends, with this
    # process.
    viewer = subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0)
    try:
        yield
    finally:
        assert viewer.stdin is not None
        viewer.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            viewer.wait(2.0)
        viewer.kill()
        viewer.wait()
