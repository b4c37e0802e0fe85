"""What `pamctl watch` shows in a terminal, 80 columns and 24 lines or more."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from pamctl.live.braille import DOTS_ACROSS, Extremes, draw_dots, find_bounds
from pamctl.live.history import History
from pamctl.log.moments import spell_controller
from pamctl.signals import Phase, find_followed_m

COLUMNS = (
    "tick", "t_s", "phase", "position_m", "reference_m", "pressure_pa", "valve_v",
)  # fmt: skip
"""Columns that the screen asks of the daemon."""
HISTORY_S = 30.0

_FRAME = 20
"""Characters of a plot's line beside the plot itself: name or unit, and a bound."""
_FEWEST_EVENTS = 3
_LOWEST_PLOT, _HIGHEST_PLOT = 2, 8
"""Lines of a plot."""
_FIGURE_WIDTH = 26
"""Characters of a figure: its name, its value and its unit."""

_STATE_STYLE = {
    "idle": "dim", "ready": "green", "homing": "yellow", "running": "bold green",
    "stopping": "yellow", "fault": "bold white on red", "away": "bold yellow",
}  # fmt: skip


class PlotLine(NamedTuple):
    """One plot."""

    name: str
    column: str
    scale: float
    unit: str
    form: str


PLOTS = (
    PlotLine("reference", "reference_m", 1e3, "mm", "8.3f"),
    PlotLine("position", "position_m", 1e3, "mm", "8.3f"),
    PlotLine("error", "error_m", 1e6, "um", "8.1f"),
    PlotLine("pressure", "pressure_pa", 1e-3, "kPa", "8.1f"),
    PlotLine("command", "valve_v", 1.0, "V", "8.3f"),
)


def add_error(tick: Mapping[str, float]) -> dict[str, float]:
    """Add the tracking error: measured displacement minus reference."""
    return {**tick, "error_m": find_followed_m(tick) - tick["reference_m"]}


def draw_screen(
    status: Mapping[str, Any] | None,
    problem: str,
    history: History,
    size: tuple[int, int],
) -> RenderableType:
    """Lay out one picture for a terminal of `size` columns and lines."""
    width, lines = size
    if status is None:
        why = _draw_headline("away", problem or "waiting for the daemon", "q quits", width)
        return Group(why, *_draw_plots(history, width, lines - 1))
    where = f"{status['backend']} {status['device']}  q quits"
    what = status["fault"] or status["run"] or ""
    figures = _list_figures(status)
    monitor = _draw_monitor(status, width)
    columns = min(3, max(1, width // _FIGURE_WIDTH))
    log = _cut_text(f"log   {status['log'] or '-'}", width, keep_end=True)
    left = lines - 3 - math.ceil(len(figures) / columns)
    plots = _draw_plots(history, width, left - _FEWEST_EVENTS)
    return Group(
        _draw_headline(status["state"], what, where, width),
        _cut_text(f"controller {spell_controller(status['names'])}", width),
        _draw_figures(figures, columns),
        *plots,
        log,
        *monitor,
        *_draw_events(status["events"], left - len(plots) - len(monitor), width),
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


def _list_figures(status: Mapping[str, Any]) -> list[tuple[str, str]]:
    tick = {k: math.nan if v is None else v for k, v in (status["tick"] or {}).items()}
    late_s, missed = status["worst_late_s"], status["missed_ticks"]
    return [
        ("reference", _format_value(tick, "reference_m", 1e3, "8.3f", "mm")),
        ("pressure", _format_value(tick, "pressure_pa", 1e-3, "7.1f", "kPa")),
        ("phase", _format_phase(tick)),
        ("position", _format_value(tick, "position_m", 1e3, "8.3f", "mm")),
        ("command", _format_value(tick, "valve_v", 1.0, "+7.3f", "V")),
        ("wake-up", "-" if late_s is None else f"{late_s * 1e6:.1f} us"),
        ("error", _format_error(tick)),
        ("time", _format_value(tick, "t_s", 1.0, "7.1f", "s")),
        ("missed", "-" if missed is None else f"{missed} ticks"),
    ]


def _draw_figures(figures: Sequence[tuple[str, str]], columns: int) -> Table:
    table = Table.grid(padding=(0, 2), expand=False)
    for _ in range(columns):
        table.add_column(style="dim", no_wrap=True)
        table.add_column(justify="right", no_wrap=True)
    for first in range(0, len(figures), columns):
        table.add_row(*(cell for pair in figures[first : first + columns] for cell in pair))
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


def _draw_plots(history: History, width: int, room: int) -> list[Text]:
    """Draw all plots in `room` lines, with the times of their ends in the last."""
    across = max(10, width - _FRAME)
    high = min(_HIGHEST_PLOT, max(_LOWEST_PLOT, (room - 1) // len(PLOTS)))
    lines = [
        line
        for plot in PLOTS
        for line in _draw_plot(plot, history.bin_column(plot.column, across * DOTS_ACROSS), high)
    ]
    begin = f"-{HISTORY_S:g} s"
    last = Text(f"{'':<{_FRAME}}{begin:<{across - 3}}now", style="dim")
    return [*lines, last]


def _draw_plot(plot: PlotLine, parts: Sequence[Extremes], high: int) -> list[Text]:
    """Draw a plot with its largest value in the first line, and its smallest in the last."""
    bounds = find_bounds(parts)
    margin = [(plot.name, bounds.high), *[("", math.nan)] * (high - 2), (plot.unit, bounds.low)]
    lines = []
    for (word, value), dots in zip(margin, draw_dots(parts, high), strict=True):
        number = "" if math.isnan(value) else f"{value * plot.scale:{plot.form}}"
        line = Text(f"{word:<10}{number:>9} ", style="dim")
        line.append(dots, style="cyan")
        lines.append(line)
    return lines


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
