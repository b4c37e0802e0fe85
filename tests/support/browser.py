"""A real browser without a screen: what it says of a page that it has been shown.

Where the tests run as root it is installed with apt, and in continuous integration it must
be there; anywhere else the tests that need it are skipped with the reason.
"""

from __future__ import annotations

import functools
import http.server
import json
import os
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from support.installing import alone, apt_install

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
PATIENCE_S = 120

LOOKING = """<!doctype html><title>looking</title><body style="margin:0">
<iframe src="page.html" style="width:%dpx;height:900px;border:0"></iframe><pre id="found"></pre>
<script>addEventListener("load", () => {
  const page = document.querySelector("iframe").contentDocument;
  const root = page.documentElement, box = (e) => e.getBoundingClientRect();
  const scrolls = (e) => e && (getComputedStyle(e).overflowX != "visible" ||
    scrolls(e.parentElement));
  const outside = [...page.querySelectorAll("main *")].filter(
    (e) => box(e).right > root.clientWidth + 1 && !scrolls(e.parentElement));
  document.getElementById("found").textContent = JSON.stringify({
    width: root.clientWidth, needed: root.scrollWidth,
    outside: outside.map((e) => e.outerHTML.slice(0, 80)),
    plots: page.querySelectorAll("svg.data path").length,
    smallest: Math.min(...[...page.querySelectorAll("svg text")].map(
      (e) => parseFloat(getComputedStyle(e).fontSize) * e.getScreenCTM().d)),
    title: page.title});
})</script>"""


@functools.cache
def browser() -> str:
    """The browser's command."""
    with alone():
        if _installed() is None:
            apt_install("chromium", "fonts-dejavu-core")
    if found := _installed():
        return found
    reason = "no Chromium, and none could be installed (apt-get install chromium, as root)"
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


def _installed() -> str | None:
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def look(page: Path, folder: Path, *, width: int) -> tuple[dict[str, Any], list[str], list[str]]:
    """Show a page in a frame; what was measured, what the console said, what was asked for."""
    (folder / "page.html").write_bytes(page.read_bytes())
    (folder / "look.html").write_text(LOOKING % width)
    with served(folder) as (address, asked):
        done = _browse(
            folder,
            "--dump-dom",
            "--enable-logging=stderr",
            "--virtual-time-budget=4000",
            f"{address}/look.html",
        )
    (found,) = re.findall(r'<pre id="found">(.*?)</pre>', done.stdout, re.S)
    console = re.findall(r"CONSOLE[:(]\d+\)?\] (.*)", done.stderr)
    return json.loads(unescape(found)), console, asked


def printed(page: Path, folder: Path) -> bytes:
    """The page as a PDF."""
    target = folder / "printed.pdf"
    _browse(folder, "--no-pdf-header-footer", f"--print-to-pdf={target}", page.as_uri())
    return target.read_bytes()


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Serve a folder to this machine alone; everything that is asked for is written down."""
    asked: list[str] = []

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args, directory=str(folder))

        def log_message(self, format: str, *args: Any) -> None:
            asked.append(self.path)

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", asked
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _browse(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [
        browser(),
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        f"--user-data-dir={folder / 'profile'}",
    ]
    return subprocess.run(
        [*command, *options], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
