"""What a viewer sees of the daemon: looks at its control socket, as lines or in a terminal."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.base.texts import to_plain_json
from pamctl.daemon.client import (
    Client,
    DaemonDeclinedError,
    DaemonUnreachableError,
    read_ticks,
    restore_nan,
)
from pamctl.log.run_meta import spell_controller
from pamctl.report.progress_line import format_progress

_PATIENCE_S = 5.0


class Glimpse(NamedTuple):
    """What is new since the last look."""

    status: dict[str, Any] | None
    """Status as the daemon sends it; None while it does not answer."""
    ticks: list[dict[str, float]]
    """Columns by name, oldest first; NaN where a value is unknown."""
    problem: str = ""
    """Why nothing can be seen; empty if all is well."""


class DaemonFeed:
    """A client of the control socket; finds the daemon again when it has been restarted."""

    def __init__(self, path: Path, every: int, fields: Sequence[str] | None = None) -> None:
        """Ask for the tick whose number `every` divides, and these columns of it, or all."""
        self._path = path
        self._every = every
        self._fields = None if fields is None else list(fields)
        self._client: Client | None = None
        self._seen = -1

    def look(self) -> Glimpse:
        """Return what is new. A daemon that is gone is no error: it may come back."""
        was_connected = self._client is not None
        try:
            return self._ask()
        except (DaemonUnreachableError, DaemonDeclinedError) as error:
            self.close()
            # It may have been restarted in the meantime.
            return self.look() if was_connected else Glimpse(None, [], str(error))

    def _ask(self) -> Glimpse:
        if self._client is None:
            self._client, self._seen = Client(self._path, _PATIENCE_S), -1
        status = self._client.call("status")
        newest = -1 if status["tick"] is None else int(status["tick"]["tick"])
        if newest < self._seen:
            self._seen = -1  # another session counts from zero
        request = {"after_tick": self._seen, "every": self._every, "fields": self._fields}
        ticks = read_ticks(self._client.call("recent", request))
        self._seen = newest
        if ticks and "tick" in ticks[-1]:
            self._seen = max(newest, int(ticks[-1]["tick"]))
        return Glimpse(status, ticks)

    def close(self) -> None:
        """Hang up."""
        if self._client is not None:
            self._client.close()
            self._client = None


LOOKS_PER_S = 10.0
EVERY = 20
"""Every twentieth tick is plotted: 50 points a second."""
COLUMNS = ("tick", "t_s", "phase", "position_m", "reference_m", "pressure_pa", "valve_v")
_STATUS_FIELDS = (
    "state", "fault", "run", "log", "worst_late_s", "missed_ticks", "backend", "device",
    "limits", "controller", "names", "gain_changes", "disk_free_bytes", "version", "events",
    "monitor",
)  # fmt: skip


def describe_glimpses(glimpses: Sequence[Glimpse], newest: Glimpse | None) -> dict[str, Any]:
    """Return the ticks of several looks, and the state of the newest."""
    newest = newest or Glimpse(None, [])
    status: dict[str, Any] | None = None
    if newest.status is not None:
        status = {name: newest.status.get(name) for name in _STATUS_FIELDS}
    rows = [[tick[name] for name in COLUMNS] for one in glimpses for tick in one.ticks]
    return {"status": status, "problem": newest.problem, "fields": COLUMNS, "ticks": rows}


def format_status(status: Mapping[str, Any]) -> str:
    """Write a status, as the daemon sends it, as a few lines."""
    what = f" ({status['run']})" if status["run"] else ""
    if status["fault"]:
        what = f": {status['fault']}"
    lines = [f"{status['state']}{what}, {status['backend']} {status['device']}"]
    if status["tick"] is not None:
        tick = restore_nan(status["tick"])
        lines.append(format_progress(tick, status["worst_late_s"]).strip())
    lines.append(f"controller: {spell_controller(status['names'])}")
    if status.get("monitor"):
        lines.append(status["monitor"]["sentence"])
    if status["log"]:
        lines.append(f"log: {status['log']}")
    lines.append(f"disk: {status['disk_free_bytes'] / 1e9:.1f} GB free")
    return "\n".join(lines)


def format_glimpse(glimpse: Glimpse) -> str:
    """Write what was seen in one look as one line."""
    if glimpse.status is None:
        return f"away: {glimpse.problem}"
    return "  ".join(format_status(glimpse.status).splitlines()[:2])


_LINES_PER_S = 1.0


def watch_in_terminal(socket: Path, count: int | None = None, *, as_json: bool = False) -> bool:
    """Show the daemon's status `count` times or until Ctrl-C; return whether it ever answered.

    A file, a pipe, or a terminal that cannot draw gets lines; with `as_json` they are what the
    page of `watch --web` is sent.
    """
    from rich.console import Console  # `pamctl status` does not wait for it
    from rich.live import Live
    from rich.text import Text

    console = Console(file=getattr(sys.stdout, "unfiltered", sys.stdout))
    draws = not as_json and console.is_terminal and not console.is_dumb_terminal
    per_s = LOOKS_PER_S if draws or as_json else _LINES_PER_S
    seen = False
    with (
        suppress(KeyboardInterrupt),
        closing(DaemonFeed(socket, EVERY, COLUMNS)) as feed,
        Live(console=console, auto_refresh=False) if draws else nullcontext() as picture,
    ):
        for number in itertools.count() if count is None else range(count):
            if number:
                time.sleep(1.0 / per_s)
            glimpse = feed.look()
            seen = seen or glimpse.status is not None
            if picture is None:
                line = to_plain_json(describe_glimpses([glimpse], glimpse)) if as_json else ""
                print(line or format_glimpse(glimpse), flush=True)
                continue
            shown = format_glimpse(glimpse) if not glimpse.status else format_status(glimpse.status)
            picture.update(Text(shown, no_wrap=True, overflow="ellipsis"), refresh=True)
    return seen
