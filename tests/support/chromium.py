"""A browser that is told what to do: Chromium's own protocol, over a pair of pipes.

Where the tests run as root it is installed with apt, and in continuous integration it must
be there; anywhere else the tests that need it are skipped with the reason.
"""

from __future__ import annotations

import base64
import functools
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from support.installing import alone, apt_install

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
PATIENCE_S = 120

MEASURE = """(() => {
  const root = document.documentElement, box = (e) => e.getBoundingClientRect();
  const scrolls = (e) => e && (getComputedStyle(e).overflowX != "visible" ||
    scrolls(e.parentElement));
  const outside = [...document.querySelectorAll("main *")].filter(
    (e) => box(e).right > root.clientWidth + 1 && !scrolls(e.parentElement));
  return {
    width: root.clientWidth, needed: root.scrollWidth,
    outside: outside.map((e) => e.outerHTML.slice(0, 80)),
    plots: document.querySelectorAll("svg.data path").length,
    smallest: Math.min(...[...document.querySelectorAll("svg text")].map(
      (e) => parseFloat(getComputedStyle(e).fontSize) * e.getScreenCTM().d)),
    title: document.title};
})()"""
"""What is measured of a page that lies still."""
IS_SHOWN = "document.readyState === 'complete' && document.querySelector('main') !== null"


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


class Page:
    """One tab, and everything that was asked for and said in it."""

    def __init__(self, sends: int, hears: int) -> None:
        self._sends, self._hears = sends, hears
        self._buffer = b""
        self._last_id = 0
        self._session = ""
        self._beside: list[str] = []
        self.events: list[dict[str, Any]] = []
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        attached = self._call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")

    def _call(self, method: str, **params: Any) -> Any:
        self._last_id += 1
        request = {"id": self._last_id, "method": method, "params": params}
        if self._session:
            request["sessionId"] = self._session
        os.write(self._sends, json.dumps(request).encode() + b"\0")
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            message = self._message(deadline_s)
            if message.get("id") == self._last_id:
                assert "error" not in message, (method, message["error"])
                return message["result"]
            self.events.append(message)

    def _message(self, deadline_s: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            assert time.monotonic() < deadline_s, "the browser does not answer"
            if select.select([self._hears], [], [], 0.5)[0]:
                piece = os.read(self._hears, 1 << 20)
                assert piece, "the browser has gone"
                self._buffer += piece
        line, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(line)
        return message

    def open(self, address: str, *, width: int, height: int) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self._call("Emulation.setDeviceMetricsOverride", **size)
        self._call("Page.navigate", url=address)

    def open_beside(self, address: str, count: int) -> None:
        """Open `count` more tabs, each in a window of its own: all are visible.

        This one stays the one that is told what to do.
        """
        session, self._session = self._session, ""
        for _ in range(count):
            made = self._call("Target.createTarget", url=address, newWindow=True)
            self._beside.append(made["targetId"])
        self._session = session

    def close_beside(self) -> None:
        """Close the tabs of `open_beside`."""
        session, self._session = self._session, ""
        while self._beside:
            self._call("Target.closeTarget", targetId=self._beside.pop())
        self._session = session

    def value(self, expression: str) -> Any:
        """Evaluate JavaScript in the page; a promise is waited for."""
        kept = f"globalThis.asked = {expression}"  # else a promise may be collected meanwhile
        asked = {"expression": kept, "returnByValue": True, "awaitPromise": True}
        answer = self._call("Runtime.evaluate", **asked)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Evaluate until it is true; a page that is not there yet is not an error."""
        tolerant = f"(() => {{ try {{ return {expression} }} catch {{ return false }} }})()"
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.value(tolerant):
            assert time.monotonic() < deadline_s, (
                expression,
                self.value("document.body.innerText"),
            )
            time.sleep(0.05)

    def click(self, selector: str) -> None:
        """Press and release the left button in the middle of an element."""
        element = f"document.querySelector({json.dumps(selector)})"
        self.value(f"{element}.scrollIntoView({{ block: 'center', behavior: 'instant' }})")
        where = f"{element}.getBoundingClientRect()"
        x, y = self.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({where})")
        for kind in ("mousePressed", "mouseReleased"):
            self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag(self, selector: str, dx: float, dy: float) -> None:
        """Press the left button on an element, move by some pixels, and release."""
        element = f"document.querySelector({json.dumps(selector)})"
        self.value(f"{element}.scrollIntoView({{ block: 'center', behavior: 'instant' }})")
        where = f"{element}.getBoundingClientRect()"
        x, y = self.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({where})")
        steps = [("mousePressed", 0.0), ("mouseMoved", 0.5), ("mouseMoved", 1.0)]
        for kind, share in [*steps, ("mouseReleased", 1.0)]:
            at = {"x": x + share * dx, "y": y + share * dy}
            self._call("Input.dispatchMouseEvent", type=kind, **at, button="left", clickCount=1)

    def press(self, *keys: str) -> None:
        """Press and release keys: `Tab`, `Enter`, `ArrowUp`, or a letter."""
        codes = {"Tab": 9, "Enter": 13, "ArrowUp": 38}
        for key in keys:
            named = {"key": key, "code": key, "windowsVirtualKeyCode": codes.get(key, ord(key[0]))}
            self._call("Input.dispatchKeyEvent", type="keyDown", **named)
            self._call("Input.dispatchKeyEvent", type="keyUp", **named)

    def choose_colours(self, scheme: str) -> None:
        """Prefer `light` or `dark` pages from now on."""
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self._call("Emulation.setEmulatedMedia", features=[feature])

    def print(self) -> bytes:
        """Return the page as a PDF."""
        return base64.b64decode(self._call("Page.printToPDF")["data"])

    def screenshot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self._call("Page.captureScreenshot")["data"]))

    @property
    def complaints(self) -> list[str]:
        """What stood on the console, errors of the network and of the security policy included."""
        wanted = ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded")
        return [json.dumps(e["params"]) for e in self.events if e.get("method") in wanted]

    @property
    def asked(self) -> list[str]:
        """All addresses that were asked for."""
        sent = [e for e in self.events if e.get("method") == "Network.requestWillBeSent"]
        return [event["params"]["request"]["url"] for event in sent]


@contextmanager
def page(folder: Path) -> Iterator[Page]:
    """Start a browser with one tab; end it."""
    its_input, our_output = os.pipe()
    our_input, its_output = os.pipe()
    # The protocol's pipes are file descriptors 3 and 4.
    script = f'exec "$@" 3<&{its_input} 4>&{its_output}'
    command = [
        browser(), "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
        "--no-first-run", "--remote-debugging-pipe", f"--user-data-dir={folder / 'profile'}",
    ]  # fmt: skip
    process = subprocess.Popen(
        ["bash", "-c", script, "bash", *command],
        pass_fds=(its_input, its_output),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(its_input)
    os.close(its_output)
    try:
        yield Page(our_output, our_input)
    finally:
        process.terminate()
        process.wait(PATIENCE_S)
        os.close(our_output)
        os.close(our_input)


def look(file: Path, folder: Path, *, width: int) -> tuple[dict[str, Any], list[str], list[str]]:
    """Show a page; return what was measured, what the console said, and what was asked for."""
    with page(folder) as tab:
        tab.open(file.as_uri(), width=width, height=900)
        tab.wait_for(IS_SHOWN)
        found = tab.value(MEASURE)
        asked = [address for address in tab.asked if not address.startswith("data:")]
        return found, tab.complaints, asked


def printed(file: Path, folder: Path) -> bytes:
    """Return a page as a PDF."""
    with page(folder) as tab:
        tab.open(file.as_uri(), width=1280, height=900)
        tab.wait_for(IS_SHOWN)
        return tab.print()
