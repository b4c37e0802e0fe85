"""`pamctl watch` in the terminal: what it shows, and what it survives."""

import fcntl
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
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.command_line import run_pamctl
from support.patience import PATIENCE_S
from support.processes.daemons import Daemon, daemon, parked

from pamctl.live.feed import DaemonFeed

NOT_HOMED = "rig.homing.enabled=false"
SHOW_CURSOR, HIDE_CURSOR = "\x1b[?25h", "\x1b[?25l"


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with daemon(tmp_path_factory.mktemp("watch"), "watch", NOT_HOMED) as made:
        yield made


@pytest.mark.long
def test_values_are_those_of_the_log(up):
    """A daemon that is started again is found again: `test_watch_web.py`."""
    from pamctl.log import read

    seen, feed = [], DaemonFeed(up.socket, every=10)
    log = up.ask("goto", position_m=8e-3, within_s=0.5)["log"]
    up.wait_until(lambda status: status["state"] == "ready" and status["log"] is not None)
    deadline_s = time.monotonic() + PATIENCE_S
    while len(seen) < 30:
        assert time.monotonic() < deadline_s, "there is nothing to see"
        seen += feed.look().ticks
        time.sleep(0.05)
    feed.close()
    up.ask("stop")
    parked(up)
    ran = read(log)
    rows = {int(tick): row for row, tick in enumerate(ran["tick"])}
    logged = [tick for tick in seen if int(tick["tick"]) in rows]
    assert len(logged) >= 10
    for tick in logged:
        row = rows[int(tick["tick"])]
        for name, value in tick.items():
            assert value == ran[name][row] or (value != value and ran[name][row] != ran[name][row])


@pytest.mark.long
def test_a_terminal_is_rewritten_a_pipe_gets_lines_and_json_is_what_the_page_is_sent(up, tmp_path):
    up.ask("goto", position_m=8e-3, within_s=0.5)
    command = [sys.executable, "-m", "pamctl", "watch", "--socket", str(up.socket)]
    picture = _seen_in_a_terminal(command, until="8.00")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as piped:
        try:
            assert piped.stdout is not None
            lines = [piped.stdout.readline() for _ in range(2)]
            piped.send_signal(signal.SIGINT)
            assert piped.wait(PATIENCE_S) == 0
        finally:
            piped.kill()
    told = _json_lines(up.socket)
    away = _json_lines(tmp_path / "none", 69)
    assert "(goto), sim" in picture
    assert "controller: qsmc" in picture
    assert all(re.search(r"\(goto\), sim .* x +-?\d+\.\d+ mm", line) for line in lines)
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


def test_a_terminal_gets_its_cursor_back_however_it_ends(tmp_path):
    command = [sys.executable, "-m", "pamctl", "watch", "--socket", str(tmp_path / "none")]
    for number, code in ((signal.SIGINT, 0), (signal.SIGTERM, 143)):
        seen = _seen_in_a_terminal(command, until="away", end=number, code=code)
        assert 0 <= seen.rfind(HIDE_CURSOR) < seen.rfind(SHOW_CURSOR), repr(seen[-100:])


def test_a_terminal_that_cannot_draw_gets_lines(tmp_path):
    command = [sys.executable, "-m", "pamctl", "watch", "--socket", str(tmp_path / "none")]
    seen = _seen_in_a_terminal(command, until="away:", kind="dumb")
    waited = r"(\r\x1b\[Kpamctl: starting, \d+ s)+\r\x1b\[K"  # on a busy machine
    assert re.sub(waited, "", seen).startswith("away:")


def _seen_in_a_terminal(
    command: list[str],
    until: str,
    *,
    kind: str = "xterm-256color",
    end: signal.Signals = signal.SIGINT,
    code: int = 0,
) -> str:
    """Run in a terminal of 80 x 24 until a text is seen; a signal ends it with `code`.

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
