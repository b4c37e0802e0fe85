"""The terminal's `pamctl watch`: ten pictures a second, or lines where it is none."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

from rich.console import Console
from rich.live import Live

from pamctl.live import line
from pamctl.live.feed import DaemonFeed, Glimpse
from pamctl.live.history import History
from pamctl.live.screen import COLUMNS, HISTORY_S, screen, with_error

_PICTURES_PER_S = 10.0
_LINES_PER_S = 1.0
_EVERY = 10
"""Ticks, of those that are plotted."""


def watch_in_terminal(
    socket: Path, line_of: Callable[[Glimpse], str], count: int | None = None
) -> None:
    """Show what the daemon does, `count` times or until Ctrl-C.

    `line_of` writes the line for a file, a pipe, or a terminal that cannot draw.
    """
    console = Console()
    with suppress(KeyboardInterrupt), closing(DaemonFeed(socket, _EVERY, COLUMNS)) as feed:
        if console.is_terminal and not console.is_dumb_terminal:
            _draw(console, _looks(feed, _PICTURES_PER_S, count))
        else:
            _print(_looks(feed, _LINES_PER_S, count), line_of)


def watch_as_json(socket: Path, count: int | None = None) -> None:
    """Print what the page of `watch --web` is sent, `count` lines or until Ctrl-C."""
    with suppress(KeyboardInterrupt), closing(DaemonFeed(socket, line.EVERY, line.COLUMNS)) as feed:
        _print(_looks(feed, line.LOOKS_PER_S, count), lambda glimpse: line.line([glimpse]))


def _looks(feed: DaemonFeed, per_s: float, count: int | None) -> Iterator[Glimpse]:
    for number in itertools.count() if count is None else range(count):
        if number:
            time.sleep(1.0 / per_s)
        yield feed.look()


def _draw(console: Console, looks: Iterator[Glimpse]) -> None:
    history = History(HISTORY_S)
    with Live(console=console, auto_refresh=False, screen=True) as live:
        for glimpse in looks:
            history.extend(with_error(tick) for tick in glimpse.ticks)
            size = (console.size.width, console.size.height)
            picture = screen(glimpse.status, glimpse.problem, history, size)
            live.update(picture, refresh=True)


def _print(looks: Iterator[Glimpse], line_of: Callable[[Glimpse], str]) -> None:
    for glimpse in looks:
        print(line_of(glimpse), flush=True)
