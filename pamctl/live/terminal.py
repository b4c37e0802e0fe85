"""`pamctl watch` in a terminal: the daemon's status, ten times a second; lines for a pipe."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.text import Text

from pamctl.live.feed import DaemonFeed, Glimpse
from pamctl.live.line import COLUMNS, EVERY, LOOKS_PER_S, encode_glimpse
from pamctl.live.status_text import format_glimpse, format_status

_LINES_PER_S = 1.0


def watch_in_terminal(socket: Path, count: int | None = None) -> bool:
    """Show the daemon's status `count` times or until Ctrl-C; return whether it ever answered.

    A file, a pipe, or a terminal that cannot draw gets lines.
    """
    console, seen = Console(file=getattr(sys.stdout, "unfiltered", sys.stdout)), _DaemonSighting()
    with suppress(KeyboardInterrupt), closing(DaemonFeed(socket, EVERY, COLUMNS)) as feed:
        if console.is_terminal and not console.is_dumb_terminal:
            _redraw_status(console, seen.of(_look_repeatedly(feed, LOOKS_PER_S, count)))
        else:
            _print_lines(seen.of(_look_repeatedly(feed, _LINES_PER_S, count)), format_glimpse)
    return seen.daemon


def watch_as_json(socket: Path, count: int | None = None) -> bool:
    """Print what the page of `watch --web` is sent, `count` lines or until Ctrl-C.

    Returns whether the daemon ever answered.
    """
    seen = _DaemonSighting()
    with suppress(KeyboardInterrupt), closing(DaemonFeed(socket, EVERY, COLUMNS)) as feed:
        _print_lines(seen.of(_look_repeatedly(feed, LOOKS_PER_S, count)), encode_glimpse)
    return seen.daemon


class _DaemonSighting:
    """Notes whether the daemon has answered."""

    daemon = False

    def of(self, looks: Iterator[Glimpse]) -> Iterator[Glimpse]:
        """Pass the glimpses on."""
        for glimpse in looks:
            self.daemon = self.daemon or glimpse.status is not None
            yield glimpse


def _look_repeatedly(feed: DaemonFeed, per_s: float, count: int | None) -> Iterator[Glimpse]:
    for number in itertools.count() if count is None else range(count):
        if number:
            time.sleep(1.0 / per_s)
        yield feed.look()


def _redraw_status(console: Console, looks: Iterator[Glimpse]) -> None:
    """Rewrite the status in place; the newest one stays on the terminal."""
    with Live(console=console, auto_refresh=False) as live:
        for glimpse in looks:
            shown = format_glimpse(glimpse)
            if glimpse.status is not None:
                shown = format_status(glimpse.status)
            live.update(Text(shown, no_wrap=True, overflow="ellipsis"), refresh=True)


def _print_lines(looks: Iterator[Glimpse], line_of: Callable[[Glimpse], str]) -> None:
    for glimpse in looks:
        print(line_of(glimpse), flush=True)
