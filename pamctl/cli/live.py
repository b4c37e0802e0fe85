"""`--live`: values for Foxglove while it runs, served by a process of its own."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Annotated

import typer

from pamctl.cli.failure import fail
from pamctl.exit_codes import ExitCode

LiveOption = Annotated[
    bool, typer.Option("--live", help="Serve Foxglove and Lichtblick; needs pamctl\\[live].")
]
LivePortOption = Annotated[
    int, typer.Option("--live-port", metavar="PORT", min=0, max=65535, help="Of --live.")
]
LiveOriginOption = Annotated[
    list[str] | None,
    typer.Option(
        "--live-origin",
        metavar="ORIGIN",
        help="Site whose pages may look on: https://app.foxglove.dev; repeats.",
    ),
]
DEFAULT_LIVE_PORT = 8765
"""Foxglove's own."""


def check_live_port(live: bool, port: int, origins: Sequence[str]) -> int | None:
    """Return where to serve, None where that is not wanted; leave where it cannot be done."""
    if not live:
        if origins:
            raise typer.BadParameter("belongs to --live, which is off", param_hint="--live-origin")
        return None
    if importlib.util.find_spec("foxglove") is None:
        what = "--live needs foxglove-sdk, which is not installed: pip install 'pamctl[live]'"
        fail(ExitCode.UNAVAILABLE, what)
    return port


@contextmanager
def serve_live_view(port: int | None, origins: Sequence[str], *source: str) -> Iterator[None]:
    """Let `pamctl.live.live_main` serve `source` on `port` meanwhile; nothing with None.

    Pages of the sites in `origins` may look on, beside programs and applications.
    """
    if port is None:
        yield
        return
    command = [sys.executable, "-m", "pamctl.live.live_main", str(port), *source, *origins]
    # It hears no Ctrl-C, and leaves when its standard input ends, with this process.
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
