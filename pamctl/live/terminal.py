"""`pamctl watch` in a terminal: ten pictures a second until `q`, or lines for a file or a pipe."""

from __future__ import annotations

import itertools
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from rich.console import Console
from rich.live import Live

from pamctl.live import line
from pamctl.live.feed import DaemonFeed, Glimpse
from pamctl.live.history import History
from pamctl.live.screen import COLUMNS, HISTORY_S, add_error, draw_screen
from pamctl.live.status_text import format_glimpse

_PICTURES_PER_S = 10.0
_LINES_PER_S = 1.0
_EVERY = 10
"""Every tenth tick is plotted."""


def watch_in_terminal(socket: Path, count: int | None = None) -> bool:
    """Show what the daemon does, `count` times or until `q`; return whether it ever answered.

    A file, a pipe, or a terminal that cannot draw gets lines.
    """
    console, seen = Console(file=getattr(sys.stdout, "unfiltered", sys.stdout)), _DaemonSighting()
    with suppress(KeyboardInterrupt), closing(DaemonFeed(socket, _EVERY, COLUMNS)) as feed:
        if console.is_terminal and not console.is_dumb_terminal:
            with read_single_keys() as wants_to_quit:
                looks = _look_repeatedly(feed, _PICTURES_PER_S, count, wants_to_quit)
                _draw_screens(console, seen.of(looks))
        else:
            _print_lines(seen.of(_look_repeatedly(feed, _LINES_PER_S, count)), format_glimpse)
    return seen.daemon


def watch_as_json(socket: Path, count: int | None = None) -> bool:
    """Print what the page of `watch --web` is sent, `count` lines or until Ctrl-C.

    Returns whether the daemon ever answered.
    """
    seen = _DaemonSighting()
    with suppress(KeyboardInterrupt), closing(DaemonFeed(socket, line.EVERY, line.COLUMNS)) as feed:
        looks = seen.of(_look_repeatedly(feed, line.LOOKS_PER_S, count))
        _print_lines(looks, line.encode_glimpse)
    return seen.daemon


class _DaemonSighting:
    """Notes whether the daemon has answered."""

    daemon = False

    def of(self, looks: Iterator[Glimpse]) -> Iterator[Glimpse]:
        """Pass the glimpses on."""
        for glimpse in looks:
            self.daemon = self.daemon or glimpse.status is not None
            yield glimpse


def _look_repeatedly(
    feed: DaemonFeed, per_s: float, count: int | None, ends: Callable[[float], bool] | None = None
) -> Iterator[Glimpse]:
    """Look; `ends` waits for so many seconds, and returns whether to stop."""
    for number in itertools.count() if count is None else range(count):
        if number and (ends or _sleep)(1.0 / per_s):
            return
        yield feed.look()


def _sleep(seconds: float) -> bool:
    time.sleep(seconds)
    return False


@contextmanager
def read_single_keys() -> Iterator[Callable[[float], bool]]:
    """Give a function that waits for some seconds, and returns whether `q` was typed meanwhile.

    Inside the block a key counts without Enter, and is not shown. The terminal gets its settings
    back however the block ends. Without a terminal there are no keys.
    """
    if sys.stdin is None or not sys.stdin.isatty():
        yield _sleep
        return
    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)

    def is_ended(seconds: float) -> bool:
        is_typed = bool(select.select([fd], [], [], seconds)[0])
        return is_typed and os.read(fd, 64).lower() in (b"q", b"")

    try:
        tty.setcbreak(fd)
        yield is_ended
    finally:
        termios.tcsetattr(fd, termios.TCSADRAIN, before)


def _draw_screens(console: Console, looks: Iterator[Glimpse]) -> None:
    history = History(HISTORY_S)
    with Live(console=console, auto_refresh=False, screen=True) as live:
        for glimpse in looks:
            history.extend(add_error(tick) for tick in glimpse.ticks)
            size = (console.size.width, console.size.height)
            picture = draw_screen(glimpse.status, glimpse.problem, history, size)
            live.update(picture, refresh=True)


def _print_lines(looks: Iterator[Glimpse], line_of: Callable[[Glimpse], str]) -> None:
    for glimpse in looks:
        print(line_of(glimpse), flush=True)
