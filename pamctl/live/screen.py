"""What `pamctl watch` shows in a terminal, 80 columns and 24 lines or more."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from pamctl.live.history import History, draw_sparkline
from pamctl.signals import Phase

COLUMNS = (
    "tick", "t_s", "phase", "position_m", "reference_m", "pressure_pa", "valve_v",
)  # fmt: skip
"""Columns that the screen asks of the daemon."""
HISTORY_S = 30.0

_LINES_BESIDE_EVENTS = 15
_FRAME = 27
"""Characters of a plot's line beside the plot itself: name, bounds, unit."""

_STATE_STYLE = {
    "idle": "dim", "ready": "green", "homing": "yellow", "running": "bold green",
    "stopping": "yellow", "fault": "bold white on red", "away": "bold yellow",
}  # fmt: skip


class PlotLine(NamedTuple):
    """One line of blocks."""

    name: str
    column: str
    scale: float
    unit: str
    form: str


PLOTS = (
    PlotLine("reference", "reference_m", 1e3, "mm", "7.2f"),
    PlotLine("position", "position_m", 1e3, "mm", "7.2f"),
    PlotLine("error", "error_m", 1e6, "um", "7.1f"),
    PlotLine("pressure", "pressure_pa", 1e-3, "kPa", "7.1f"),
    PlotLine("command", "valve_v", 1.0, "V", "7.2f"),
)


def add_error(tick: Mapping[str, float]) -> dict[str, float]:
    """Add the tracking error: measured displacement minus reference."""
    return {**tick, "error_m": tick["position_m"] - tick["reference_m"]}


def draw_screen(
    status: Mapping[str, Any] | None,
    problem: str,
    history: History,
    size: tuple[int, int],
) -> RenderableType:
    """Lay out one picture for a terminal of `size` columns and lines."""
    width, lines = size
    if status is None:
        return Group(
            _draw_headline("away", problem or "waiting for the daemon", "", width),
            *_draw_plots(history, width),
        )
    where = f"{status['backend']} {status['device']}"
    room = lines - _LINES_BESIDE_EVENTS - (status.get("monitor") is not None)
    what = status["fault"] or status["run"] or ""
    return Group(
        _draw_headline(status["state"], what, where, width),
        Text(),
        _draw_figures(status),
        Text(),
        *_draw_plots(history, width),
        Text(),
        _cut_text(f"log   {status['log'] or '-'}", width, keep_end=True),
        *_draw_monitor(status, width),
        *_draw_events(status["events"], room, width),
    )


def _draw_monitor(status: Mapping[str, Any], width: int) -> list[Text]:
    monitor = status.get("monitor")
    if monitor is None:
        return []
    line = _cut_text(monitor["sentence"], width)
    is_off = any(block["state"] == "off" for block in monitor["blocks"])
    line.stylize("bold red" if is_off else "dim")
    return [line]


def _draw_headline(state: str, what: str, where: str, width: int) -> Text:
    line = Text(f" {state} ", style=_STATE_STYLE.get(state, ""))
    line.append(f" {what}", style="bold red" if state == "fault" else "bold")
    room = max(1, width - len(where) - 1)
    line.truncate(room, overflow="ellipsis", pad=True)
    line.append(f" {where}", style="dim")
    return line


def _draw_figures(status: Mapping[str, Any]) -> Table:
    tick = {k: math.nan if v is None else v for k, v in (status["tick"] or {}).items()}
    table = Table.grid(padding=(0, 3), expand=False)
    for _ in range(3):
        table.add_column(style="dim", no_wrap=True)
        table.add_column(justify="right", no_wrap=True)
    late_s, missed = status["worst_late_s"], status["missed_ticks"]
    rows = (
        (
            ("reference", _format_value(tick, "reference_m", 1e3, "8.3f", "mm")),
            ("pressure", _format_value(tick, "pressure_pa", 1e-3, "7.1f", "kPa")),
            ("phase", _format_phase(tick)),
        ),
        (
            ("position", _format_value(tick, "position_m", 1e3, "8.3f", "mm")),
            ("command", _format_value(tick, "valve_v", 1.0, "+7.3f", "V")),
            ("worst wake-up", "-" if late_s is None else f"{late_s * 1e6:.1f} us"),
        ),
        (
            ("error", _format_error(tick)),
            ("time", _format_value(tick, "t_s", 1.0, "7.1f", "s")),
            ("missed ticks", "-" if missed is None else str(missed)),
        ),
    )
    for row in rows:
        table.add_row(*(cell for pair in row for cell in pair))
    return table


def _format_value(
    tick: Mapping[str, float], column: str, scale: float, form: str, unit: str
) -> str:
    value = tick.get(column, math.nan)
    return f"- {unit}" if math.isnan(value) else f"{value * scale:{form}} {unit}"


def _format_error(tick: Mapping[str, float]) -> str:
    return _format_value(add_error(tick), "error_m", 1e6, "+8.1f", "um") if tick else "- um"


def _format_phase(tick: Mapping[str, float]) -> str:
    return Phase(int(tick["phase"])).name.lower().replace("_", " ") if tick else "-"


def _draw_plots(history: History, width: int) -> list[Text]:
    room = max(10, width - _FRAME - 3)
    lines = []
    for plot in PLOTS:
        blocks, low, high = draw_sparkline(history.bin_column(plot.column, room))
        bounds = "" if math.isnan(low) else _format_bounds(low, high, plot)
        line = Text(f"{plot.name:<10}", style="dim")
        line.append(blocks, style="cyan")
        line.append(f" {bounds}", style="dim")
        lines.append(line)
    last = Text(f"{'':<10}{'-' + format(HISTORY_S, 'g') + ' s':<{room - 3}}now", style="dim")
    return [*lines, last]


def _format_bounds(low: float, high: float, plot: PlotLine) -> str:
    numbers = (f"{value * plot.scale:{plot.form}}".strip() for value in (low, high))
    return f"{'..'.join(numbers)} {plot.unit}"


def _draw_events(events: Sequence[Mapping[str, Any]], room: int, width: int) -> list[Text]:
    newest = list(events)[-room:] if room > 0 else []
    return [_cut_text(_format_event(event), width) for event in newest]


def _format_event(event: Mapping[str, Any]) -> str:
    at = time.strftime("%H:%M:%S", time.localtime(event["time_s"]))
    details = (
        f"{k} {v}" for k, v in event.items() if k not in ("event", "time_s", "log") and v != ""
    )
    return f"{at}  {event['event']}  {', '.join(details)}"


def _cut_text(text: str, width: int, *, keep_end: bool = False) -> Text:
    if len(text) > width and keep_end:
        text = f"{text[:6]}...{text[len(text) - width + 9 :]}"
    line = Text(text, style="dim")
    line.truncate(width, overflow="ellipsis")
    return line
