"""`pamctl watch --web`: what a browser sees and may do, and what other sites may not."""

import json
import os
import re
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from support.chromium import Page, page
from support.command_line import run_process
from support.patience import PATIENCE_S, await_true
from support.processes.daemons import Daemon, daemon
from support.processes.watch_pages import Served, served

NOT_HOMED = "rig.homing.enabled=false"

OUTSIDE = """[...document.querySelectorAll("body *")].filter(
  e => e.getBoundingClientRect().right > 391 && !e.parentElement.closest(".wide")
).map(e => e.outerHTML.slice(0, 80))"""
"""Wide tables scroll in a box of their own, which must fit."""


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with daemon(tmp_path_factory.mktemp("web"), "web", NOT_HOMED, options=["--rt", "auto"]) as made:
        yield made


@pytest.fixture(scope="module")
def controlled(up: Daemon) -> Iterator[Served]:
    with served(up, "--allow-control") as made:
        yield made


# --- in a browser ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with page(tmp_path_factory.mktemp("browser")) as made:
        yield made


@pytest.mark.long
def test_plots_move_and_fit_the_page_and_the_emergency_stop_ends_at_the_safe_voltage(
    up, controlled, tab
):
    up.ask("goto", position_m=8e-3, within_s=0.5)
    tab.open(controlled.address, width=1280, height=900)
    tab.wait_for("charts[0].chart.data[0].length > 20")
    tab.wait_for("document.querySelector('#state').textContent === 'ready'")
    count = tab.value("series.t[series.t.length - 1]")
    tab.value("window.before = document.querySelector('.plot canvas').toDataURL()")
    tab.wait_for(f"series.t[series.t.length - 1] > {count}")
    tab.wait_for("document.querySelector('.plot canvas').toDataURL() !== before")
    shown_mm = tab.value("parseFloat(document.querySelector('#position').textContent)")
    assert shown_mm == pytest.approx(8.0, abs=0.05)

    tab.open(controlled.address, width=390, height=844)
    tab.wait_for("charts[0].chart.data[0].length > 20")
    assert tab.value("document.documentElement.scrollWidth") <= 390
    assert tab.value(OUTSIDE) == []

    tab.value("document.querySelector('#target').value = '9'")
    tab.click("#goto")
    up.wait_until(lambda s: s["tick"]["reference_m"] == pytest.approx(9e-3))
    assert not up.is_safe()
    # More tabs than the connections that a browser opens to one server.
    tab.open_beside(controlled.address, 7)
    tab.click("#estop")
    up.wait_safe()
    tab.wait_for("document.querySelector('#state').textContent === 'fault'")
    tab.wait_for("!document.querySelector('#notice').textContent.includes('NOT SENT')")
    assert "emergency stop" in tab.value("document.querySelector('#what').textContent")
    tab.close_beside()
    assert tab.complaints == []
    own = f"http://127.0.0.1:{controlled.port}/"
    assert {a for a in tab.asked if not a.startswith((own, "data:"))} == set()
    up.wait_until(lambda s: not s["pids"])
    up.ask("ack")


@pytest.mark.long
def test_an_order_that_is_not_confirmed_says_so_until_it_is(up, controlled, tab):
    tab.open("about:blank", width=390, height=844)
    tab.open(controlled.address, width=390, height=844)
    tab.wait_for("document.querySelector('#state').textContent === 'idle'")
    os.kill(controlled.pid, signal.SIGSTOP)
    try:
        tab.click("#estop")
        tab.wait_for("document.querySelector('#notice').textContent.includes('NOT SENT')")
        assert "pamctl estop" in tab.value("document.querySelector('#notice').textContent")
        red = "getComputedStyle(document.querySelector('#notice')).backgroundColor"
        assert tab.value(red) == "rgb(192, 45, 18)"
        tab.wait_for("document.querySelector('#state').textContent === 'away'")
    finally:
        os.kill(controlled.pid, signal.SIGCONT)
    tab.wait_for("document.querySelector('#state').textContent === 'fault'")
    tab.wait_for("!document.querySelector('#notice').textContent.includes('NOT SENT')")
    up.ask("ack")


@pytest.mark.long
def test_an_open_page_survives_a_restart_of_the_daemon(tmp_path, tab):
    with daemon(tmp_path, "again", NOT_HOMED) as first, served(first) as shown:
        before = len(tab.complaints)
        tab.open(shown.address, width=1280, height=900)
        tab.wait_for("document.querySelector('#state').textContent === 'idle'")
        tab.wait_for("document.querySelector('#mode').textContent.includes('pamctl estop')")
        assert tab.value("document.querySelector('#estop').hidden"), "it would do nothing"
        first.process.send_signal(signal.SIGTERM)
        first.process.wait(PATIENCE_S)
        tab.wait_for("document.querySelector('#state').textContent === 'away'")
        with daemon(tmp_path, "again", NOT_HOMED):
            tab.wait_for("document.querySelector('#state').textContent === 'idle'")
        assert tab.complaints[before:] == []
        tab.open("about:blank", width=1280, height=900)


# --- who may ask what --------------------------------------------------------------------------


def test_every_answer_has_a_policy_that_admits_only_its_own_origin(controlled):
    for path in ("/", "/page.js", "/page.css", "/uplot.js", "/uplot.css", "/icon.svg", "/nothing"):
        status, body, headers = controlled.ask("GET", path)
        assert status == (404 if path == "/nothing" else 200)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert "Access-Control-Allow-Origin" not in headers
        assert controlled.token.encode() not in body
    page_text = controlled.ask("GET", "/")[1].decode()
    assert not re.search(r"<script(?![^>]*src=)|<style|\son\w+=|style=|https?://", page_text)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "", "[::1]:1"])
def test_a_foreign_host_name_for_this_address_is_refused(controlled, host):
    for method, path in (("GET", "/"), ("GET", "/news?"), ("POST", "/do")):
        assert controlled.ask(method, path, Host=host)[0] == 421


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "https://127.0.0.1:{port}"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
)
def test_another_site_can_neither_read_nor_order_even_with_the_token(controlled, headers):
    given = {name: value.format(port=controlled.port) for name, value in headers.items()}
    assert controlled.ask("GET", "/news?", **given)[0] == 403
    assert controlled.order({"do": "stop"}, **given)[0] == 403


@pytest.mark.parametrize("token", ["", "x", "Bearer", "\u00e9"])
def test_without_the_token_nothing_can_be_ordered(controlled, token):
    status, said = controlled.order({"do": "estop"}, Authorization=f"Bearer {token}")
    assert status == 401
    assert "whole address" in said
    assert controlled.daemon.state() != "fault"


def test_nothing_can_be_ordered_without_the_option_allow_control(up):
    with served(up) as shown:
        assert shown.token == ""
        assert shown.order({"do": "estop"})[0] == 403
        assert shown.order({"do": "estop"}, Authorization="Bearer ")[0] == 403
        assert shown.ask("GET", "/news?")[0] == 200
    assert up.state() != "fault"


@pytest.mark.parametrize(
    ("what", "status"),
    [
        ({"do": "explode"}, 400), ({"do": "set", "changes": []}, 400), ([], 400), ("estop", 400),
        ({"do": "goto"}, 400), ({"do": "goto", "position_mm": "far"}, 400),
        ({"do": "goto", "position_mm": True}, 400), ({"do": "goto", "position_mm": 10**400}, 400),
        ({"do": "goto", "position_mm": float("nan")}, 400),
        ({"do": "goto", "position_mm": 500}, 409), ({"do": "stop"}, 409),
    ],
)  # fmt: skip
def test_an_invalid_order_is_refused(controlled, what, status):
    controlled.daemon.wait_for("idle", "ready")
    assert controlled.order(what)[0] == status


def test_an_order_is_small_json_with_a_length(controlled):
    bearer = {"Authorization": f"Bearer {controlled.token}"}
    json_type = {**bearer, "Content_Type": "application/json"}
    assert controlled.ask("POST", "/do", b"{}", **bearer)[0] == 415
    assert controlled.ask("POST", "/do", b"{}", **bearer, Content_Type="text/plain")[0] == 415
    assert controlled.ask("POST", "/do", b"{", **json_type)[0] == 400
    assert controlled.ask("POST", "/do", b"[" * 4000, **json_type)[0] == 400
    assert controlled.ask("POST", "/do", b" " * 5000, **json_type)[0] == 413
    huge = {**json_type, "Content_Length": "99999999999"}
    assert controlled.ask("POST", "/do", None, **huge)[0] == 413
    assert controlled.ask("POST", "/do", None, **{**huge, "Content_Length": "9" * 5000})[0] == 413
    assert controlled.ask("POST", "/do", None, **{**huge, "Content_Length": "-1"})[0] == 411


def test_a_crowd_of_silent_connections_keeps_nobody_out(controlled):
    at = ("127.0.0.1", controlled.port)
    with ExitStack() as stack:
        for _ in range(40):
            stack.enter_context(socket.create_connection(at))
        assert controlled.ask("GET", "/news?")[0] == 200


def test_news_are_those_since_the_look_that_is_named(controlled):
    def news(query: str) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(controlled.ask("GET", f"/news?{query}")[1])
        return told

    controlled.daemon.ask("goto", position_m=8e-3, within_s=1.0)
    controlled.daemon.wait_until(lambda status: status["tick"] is not None)
    await_true(lambda: news("")["ticks"])
    first = news("")
    later = news(f"server={first['server']}&after={first['look']}")
    assert all(row[0] > first["ticks"][-1][0] for row in later["ticks"])
    for query in ("after=99", "server=x&after=99", f"server={first['server']}&after=" + "9" * 400):
        anew = news(query)
        since = news(f"server={anew['server']}&after={anew['look']}")
        assert len(anew["ticks"]) > len(since["ticks"]), "not only what is new"
    controlled.daemon.ask("disarm")


def test_an_emergency_stop_gets_through_a_flood_of_requests(controlled):
    body = b'{"do": "explode"}'
    request = (
        f"POST /do HTTP/1.1\r\nHost: 127.0.0.1:{controlled.port}\r\nContent-Length: {len(body)}\r\n"
        f"Content-Type: application/json\r\nAuthorization: Bearer {controlled.token}\r\n\r\n"
    ).encode() + body
    with ExitStack() as stack:
        at = ("127.0.0.1", controlled.port)
        crowd = [stack.enter_context(socket.create_connection(at)) for _ in range(64)]
        for one in crowd:
            one.sendall(request)
        assert controlled.order({"do": "estop"})[0] == 200
        assert all(b" 400 " in one.makefile("rb").readline() for one in crowd)
    controlled.daemon.acknowledge()


def test_the_page_listens_on_this_pc_only(controlled):
    listening = Path("/proc/net/tcp").read_text().splitlines()[1:]
    ours = [line.split()[1] for line in listening if line.split()[3] == "0A"]
    assert f"0100007F:{controlled.port:04X}" in ours
    assert f"00000000:{controlled.port:04X}" not in ours


def test_a_taken_port_is_one_clear_line(up):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        command = [sys.executable, "-m", "pamctl", "watch", "--web", "--port", port]
        done = run_process(command)
    assert done.returncode == 69
    assert done.stderr.startswith(f"error: port {port}:")
    assert "--port" in done.stderr
