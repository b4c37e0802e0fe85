"""`pamctl watch --web` in a process of its own, for the tests that open its page."""

from __future__ import annotations

import http.client
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest

from support.chromium import Page, page
from support.patience import PATIENCE_S
from support.processes.daemons import NOT_HOMED, Daemon, daemon


class Served(NamedTuple):
    """A served page, and the daemon behind it."""

    daemon: Daemon
    address: str
    port: int
    token: str
    pid: int

    def ask(
        self, method: str, path: str, body: bytes | None = None, **headers: str
    ) -> tuple[int, bytes, http.client.HTTPMessage]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, body, sent)
        answer = connection.getresponse()
        read = answer.read()
        connection.close()
        return answer.status, read, answer.headers

    def order(self, what: object, **headers: str) -> tuple[int, str]:
        given = {"Content_Type": "application/json", "Authorization": f"Bearer {self.token}"}
        status, body, _ = self.ask("POST", "/do", json.dumps(what).encode(), **{**given, **headers})
        told: dict[str, Any] | None = json.loads(body)
        return status, (told or {}).get("error", "")


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon whose page is open in a browser."""
    with daemon(tmp_path_factory.mktemp("page"), "page", NOT_HOMED) as made:
        yield made


@pytest.fixture(scope="module")
def shown(up: Daemon) -> Iterator[Served]:
    with served(up, "--allow-control") as made:
        yield made


@pytest.fixture(scope="module")
def tab(shown: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with page(tmp_path_factory.mktemp("browser")) as made:
        made.open(shown.address, width=1280, height=1000)
        made.wait_for("bench.fields.length && scope.charts.length && bench.gains.length")
        yield made


@contextmanager
def served(made: Daemon, *options: str) -> Iterator[Served]:
    command = [sys.executable, "-m", "pamctl", "watch", "--web", "--port", "0", *options]
    process = subprocess.Popen(
        [*command, "--socket", str(made.socket)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline().strip()
        found = re.fullmatch(r"(http://127\.0\.0\.1:(\d+)/)(?:#(\S+))?", line)
        assert found is not None, line
        yield Served(made, line, int(found[2]), found[3] or "", process.pid)
    finally:
        with process:
            process.send_signal(signal.SIGINT)
            try:
                assert process.wait(PATIENCE_S) == 0
            finally:
                process.kill()


def set_input(tab: Page, name: str, value: object) -> None:
    """Change an input of the page, as a user does."""
    tab.value(
        f"(() => {{ const one = byId({json.dumps(name)}); one.value = {json.dumps(str(value))};"
        " one.dispatchEvent(new Event('change', { bubbles: true })); })()"
    )
