"""`pamctl watch` in the terminal: what it shows, in how much room, and what it survives."""

from __future__ import annotations

import fcntl
import io
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from support.command_line import run_pamctl
from support.patience import PATIENCE_S
from support.processes.daemons import daemon

from pamctl.live.braille import BLANK, Extremes, draw_dots, find_bounds
from pamctl.live.feed import DaemonFeed
from pamctl.live.history import History
from pamctl.live.screen import HISTORY_S, add_error, draw_screen

NOT_HOMED = "rig.homing.enabled=false"
SHOW_CURSOR, LEAVE_SCREEN = "\x1b[?25h", "\x1b[?1049l"

TICK = {
    "tick": 1000, "t_s": 1.0, "phase": 2, "position_m": 11.801e-3, "reference_m": 11.8e-3,
    "pressure_pa": 301.3e3, "valve_v": -0.25,
}  # fmt: skip
STATUS: dict[str, Any] = {
    "state": "running", "fault": "", "run": "tracking-2", "log": "/a/rather/long/" + "x" * 90,
    "tick": TICK, "worst_late_s": 123.4e-6, "missed_ticks": 7, "backend": "sim", "device": "sim0",
    "names": {"controller": "qsmc", "controller_changes": "lambda_per_s 60 (file 37.82)"},
    "events": [{"event": "mark", "time_s": 0.0, "text": "y" * 200}] * 10,
}  # fmt: skip


def drawn(status: dict[str, Any] | None, *ticks: dict[str, float], size: tuple[int, int]) -> str:
    history = History(HISTORY_S)
    history.extend(add_error(tick) for tick in ticks)
    paper = io.StringIO()
    console = Console(file=paper, width=200, height=60, force_terminal=False)
    console.print(draw_screen(status, "no daemon", history, size))
    return paper.getvalue()


@given(st.lists(st.floats(-1e6, 1e6) | st.just(float("nan")), max_size=80), st.integers(1, 8))
def test_dots_are_as_high_as_the_values(values: list[float], lines: int) -> None:
    parts = [Extremes(value, value) for value in values]
    drawn, (low, high) = draw_dots(parts, lines), find_bounds(parts)
    assert [len(line) for line in drawn] == [(len(values) + 1) // 2] * lines
    for at, value in enumerate(values):
        rows = [4 * lines - 1 - row for row in range(4 * lines) if dot(drawn, at, row)]
        if value != value:
            assert rows == []
        elif low < high:
            asked = (4 * lines - 1) * (value - low) / (high - low)
            assert min(abs(row - asked) for row in rows) <= 0.5 + 1e-6


def dot(drawn: list[str], at: int, row: int) -> bool:
    """Whether a dot is set, by the numbering of the Unicode block: 1 2 3 7 down, then 4 5 6 8."""
    number = (1, 2, 3, 7, 4, 5, 6, 8)[4 * (at % 2) + row % 4]
    return bool((ord(drawn[row // 4][at // 2]) - 0x2800) >> (number - 1) & 1)


def test_a_step_is_drawn_without_a_hole() -> None:
    parts = [Extremes(0.0, 0.0), Extremes(1.0, 1.0)]
    drawn = draw_dots(parts, 2)
    assert [row for row in range(8) if dot(drawn, 1, row)] == list(range(7))


def test_a_peak_of_one_tick_is_not_averaged_away() -> None:
    history = History(10.0)
    ticks = ({"t_s": n * 0.01, "error_m": {333: 5.0, 334: -4.0}.get(n, 0.0)} for n in range(1001))
    history.extend(ticks)
    assert find_bounds(history.bin_column("error_m", 40)) == (-4.0, 5.0)


def test_a_history_restarts_with_a_new_session() -> None:
    history = History(10.0)
    history.extend({"t_s": t_s, "error_m": 9.0} for t_s in (50.0, 50.5))
    history.extend([{"t_s": 0.1, "error_m": 1.0}])
    assert find_bounds(history.bin_column("error_m", 10)) == (1.0, 1.0)


@pytest.mark.parametrize(
    "status",
    [
        STATUS,
        None,
        {**STATUS, "state": "fault", "fault": "safety trip: " + "z" * 200},
        {**STATUS, "tick": None, "state": "idle", "run": None, "log": None, "events": []},
        {**STATUS, "tick": {**TICK, "reference_m": None, "pressure_pa": None}},
    ],
)
@pytest.mark.parametrize("size", [(80, 24), (60, 30), (140, 60)])
def test_every_state_fits_into_the_terminal(
    status: dict[str, Any] | None, size: tuple[int, int]
) -> None:
    lines = drawn(status, {**TICK, "t_s": 0.5}, TICK, size=size).rstrip("\n").split("\n")
    assert len(lines) <= size[1]
    assert max(len(line.rstrip()) for line in lines) <= size[0]
    assert len(lines) >= 0.7 * size[1], "the room is used"


@pytest.mark.parametrize("size", [(60, 30), (80, 24), (200, 60)])
def test_figures_are_in_millimetres_and_kilopascals_in_any_width(size: tuple[int, int]) -> None:
    text = drawn(STATUS, TICK, size=size)
    assert "qsmc*, lambda_per_s 60 (file 37.82)" in text
    for figure in ("11.800 mm", "11.801 mm", "+1.0 um", "301.3 kPa", "-0.250 V", "123.4 us", "7"):
        assert figure in text


@pytest.mark.long
def test_values_are_those_of_the_log_and_a_restarted_daemon_is_found_again(tmp_path: Path) -> None:
    from pamctl.log import read

    seen = []
    with daemon(tmp_path, "feed", NOT_HOMED) as made:
        feed = DaemonFeed(made.socket, every=10)
        log = made.ask("goto", position_m=8e-3, within_s=0.5)["log"]
        made.wait_until(lambda status: status["state"] == "ready" and status["log"] is not None)
        deadline_s = time.monotonic() + PATIENCE_S
        while len(seen) < 60:
            assert time.monotonic() < deadline_s, "there is nothing to see"
            seen += feed.look().ticks
            time.sleep(0.05)
    away = feed.look()
    assert (away.status, away.ticks) == (None, [])
    assert "pamctl daemon" in away.problem
    ran = read(log)
    rows = {int(tick): row for row, tick in enumerate(ran["tick"])}
    logged = [tick for tick in seen if int(tick["tick"]) in rows]
    assert len(logged) >= 10
    for tick in logged:
        row = rows[int(tick["tick"])]
        for name, value in tick.items():
            assert value == ran[name][row] or (value != value and ran[name][row] != ran[name][row])
    with daemon(tmp_path, "feed", NOT_HOMED):
        back = feed.look().status
        assert back is not None
        assert back["state"] == "idle"
        feed.close()


@pytest.mark.long
def test_in_a_terminal_it_draws_and_in_a_pipe_it_writes_lines(tmp_path: Path) -> None:
    with daemon(tmp_path, "watch", NOT_HOMED) as made:
        made.ask("goto", position_m=8e-3, within_s=0.5)
        command = [sys.executable, "-m", "pamctl", "watch", "--socket", str(made.socket)]
        picture = _seen_in_a_terminal(command, until="8.00")
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as piped:
            try:
                assert piped.stdout is not None
                lines = [piped.stdout.readline() for _ in range(2)]
                piped.send_signal(signal.SIGINT)
                assert piped.wait(PATIENCE_S) == 0
            finally:
                piped.kill()
    assert "position" in picture
    assert any(BLANK < one <= "\u28ff" for one in picture)
    assert all(re.search(r"\(goto\), sim .* x +-?\d+\.\d+ mm", line) for line in lines)


@pytest.mark.long
def test_lines_of_json_are_what_the_page_is_sent(tmp_path: Path) -> None:
    with daemon(tmp_path, "lines", NOT_HOMED) as made:
        made.ask("goto", position_m=8e-3, within_s=0.5)
        made.wait_until(lambda status: status["tick"] is not None)
        told = _json_lines(made.socket)
    away = _json_lines(made.socket, 69)
    assert [line["status"]["run"] for line in told] == 3 * ["goto"]
    ticks = [row[told[0]["fields"].index("tick")] for line in told for row in line["ticks"]]
    assert ticks == sorted(set(ticks))
    assert all(tick % 20 == 0 for tick in ticks)
    assert [line["status"] for line in away] == 3 * [None]
    assert "pamctl daemon" in away[0]["problem"]


def _json_lines(socket: Path, code: int = 0) -> list[dict[str, Any]]:
    done = run_pamctl("watch", "--json", "--count", "3", "--socket", socket)
    assert done.returncode == code, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_terminal_gets_its_cursor_and_its_lines_back_however_it_ends(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pamctl", "watch", "--socket", str(tmp_path / "none")]
    ends: tuple[tuple[signal.Signals | bytes, int], ...] = (
        (signal.SIGINT, 0), (signal.SIGTERM, 143), (b"q", 0),
    )  # fmt: skip
    for number, code in ends:
        seen = _seen_in_a_terminal(command, until="away", end=number, code=code)
        assert seen.endswith(SHOW_CURSOR + LEAVE_SCREEN), repr(seen[-100:])


def test_a_terminal_that_cannot_draw_gets_lines(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pamctl", "watch", "--socket", str(tmp_path / "none")]
    seen = _seen_in_a_terminal(command, until="away:", kind="dumb")
    waited = r"(\r\x1b\[Kpamctl: starting, \d+ s)+\r\x1b\[K"  # on a busy machine
    assert re.sub(waited, "", seen).startswith("away:")


def _seen_in_a_terminal(
    command: list[str],
    until: str,
    *,
    kind: str = "xterm-256color",
    end: signal.Signals | bytes = signal.SIGINT,
    code: int = 0,
) -> str:
    """Run in a terminal of 80 x 24 until a text is seen; a signal or a key ends it with `code`.

    The terminal's settings must then be what they were.
    """
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    environment = {**os.environ, "TERM": kind}
    process = subprocess.Popen(command, stdin=its, stdout=its, stderr=its, env=environment)
    settings = termios.tcgetattr(its)
    seen, deadline_s = b"", time.monotonic() + PATIENCE_S
    try:
        while until not in seen.decode(errors="replace"):
            assert time.monotonic() < deadline_s, seen[-2000:]
            if select.select([ours], [], [], 0.1)[0]:
                seen += os.read(ours, 65536)
        if isinstance(end, bytes):
            os.write(ours, end)
        else:
            process.send_signal(end)
        rest: list[bytes] = []
        drain = threading.Thread(target=_drain, args=(ours, rest), daemon=True)
        drain.start()
        assert process.wait(PATIENCE_S) == code
        assert termios.tcgetattr(its) == settings
        os.close(its)  # the last one: now the terminal ends
        drain.join(PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    os.close(ours)
    return (seen + b"".join(rest)).decode(errors="replace")


def _drain(fd: int, rest: list[bytes]) -> None:
    try:
        while piece := os.read(fd, 65536):
            rest.append(piece)
    except OSError:
        pass  # the other end is closed
