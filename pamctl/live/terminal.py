"""The terminal's `pamctl watch`: ten pictures a second, or plain lines where it is none."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rich.console import Console
from rich.live import Live

from pamctl.live.feed import DaemonFeed, Glimpse
from pamctl.live.history import History
from pamctl.live.screen import COLUMNS, HISTORY_S, screen, with_error

_PICTURES_PER_S = 10.0
_LINES_PER_S = 1.0
_EVERY = 10
"""Ticks, of those that are plotted."""


def watch_in_terminal(socket: Path, line_of: Callable[[Glimpse], str]) -> None:
    """Show what the daemon does until Ctrl-C; `line_of` writes the line for a file or a pipe."""
    console = Console()
    feed = DaemonFeed(socket, _EVERY, COLUMNS)
    with suppress(KeyboardInterrupt):
        if console.is_terminal:
            _pictures(console, feed)
        else:
            _lines(feed, line_of)
    feed.close()


def _pictures(console: Console, feed: DaemonFeed) -> None:
    history = History(HISTORY_S)
    with Live(console=console, auto_refresh=False, screen=True) as live:
        while True:
            glimpse = feed.look()
            history.extend(with_error(tick) for tick in glimpse.ticks)
            size = (console.size.width, console.size.height)
            picture = screen(glimpse.status, glimpse.problem, history, size)
            live.update(picture, refresh=True)
            time.sleep(1.0 / _PICTURES_PER_S)


def _lines(feed: DaemonFeed, line_of: Callable[[Glimpse], str]) -> None:
    while True:
        print(line_of(feed.look()), flush=True)
        time.sleep(1.0 / _LINES_PER_S)
