"""`pamctl watch --web`: a page for the browsers of this PC only.

    GET /            the page, its script, its style, uPlot
    GET /news        what is new since the look that the page has seen last
    GET /scope/...   ticks at full rate, and searches for a trigger in them
    GET /bench       the gains with their bounds, and the experiments
    GET /runs        the newest runs of the daemon's folder
    POST /do         an order; only with --allow-control and its token

Each request is answered at once: the page asks for news ten times a second, and an order is
confirmed when it is taken. A browser opens at most six connections to one address, for all of its
tabs together. No tab may hold one of them, or an order would wait for it.

It is a process of its own and an ordinary client of the control socket: neither it nor any
browser can touch the loop. Loopback alone does not protect from pages of other sites in the same
browser: Host and Origin are checked, and the token is in the part of the address that a browser
never sends.
"""

from __future__ import annotations

import hmac
import json
import secrets
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pamctl.base.texts import to_plain_json
from pamctl.live.feed import COLUMNS, EVERY, LOOKS_PER_S, DaemonFeed, Glimpse, describe_glimpses
from pamctl.live.page_orders import (
    PageOrders,
    PageRefusal,
    describe_bench,
    list_runs,
    translate_order,
)
from pamctl.live.scope import Scope
from pamctl.live.tick_memory import TickMemory
from pamctl.report.html_page import COLOURS

_KEPT_LOOKS = round(60 * LOOKS_PER_S)
_FOLLOW_EVERY_S = 0.05


class Broadcast:
    """Looks at the daemon ten times a second, and keeps the last minute for new viewers."""

    def __init__(self, socket: Path) -> None:
        """Begin to look now."""
        self._feed = DaemonFeed(socket, EVERY, COLUMNS)
        self.memory = TickMemory()
        self.scope = Scope(self.memory)
        self._news = threading.Lock()
        self._kept: deque[Glimpse] = deque(maxlen=_KEPT_LOOKS)
        self._count = 0
        self._looked_s = time.monotonic()
        self._ended = threading.Event()
        # A daemon that is slow to answer must not cost ticks: the ring goes on without it.
        self._threads = [
            threading.Thread(target=work, daemon=True)
            for work in (self._poll_feed, self._follow_run)
        ]
        for thread in self._threads:
            thread.start()

    def _poll_feed(self) -> None:
        while not self._ended.wait(1.0 / LOOKS_PER_S):
            glimpse = self._feed.look()
            with self._news:
                self._kept.append(glimpse)
                self._count += 1
                self._looked_s = time.monotonic()
        self._feed.close()

    def _follow_run(self) -> None:
        while not self._ended.wait(_FOLLOW_EVERY_S):
            status = self.newest_status()
            if status is None:
                self.memory.follow(None, None)
                continue
            self.scope.folder = Path(status["logs"])
            self.memory.follow(status.get("ring"), status["log"])
        self.memory.close()

    def newest_status(self) -> dict[str, Any] | None:
        """Return the daemon's status; None while it does not answer."""
        with self._news:
            return self._kept[-1].status if self._kept else None

    def encode_news(self, seen: int, more: Mapping[str, object]) -> bytes:
        """Return as JSON: all since look number `seen`, the newest state, and `more`.

        `look` is the number to name next time; `age_s` is the time since the newest look.
        """
        with self._news:
            missing = min(max(self._count - seen, 0), len(self._kept))
            fresh = [self._kept[len(self._kept) - missing + i] for i in range(missing)]
            newest = self._kept[-1] if self._kept else None
            count, age_s = self._count, time.monotonic() - self._looked_s
        document = describe_glimpses(fresh, newest)
        return to_plain_json({"look": count, "age_s": age_s, **more, **document}).encode()

    def end(self) -> None:
        """Stop looking."""
        self._ended.set()
        for thread in self._threads:
            thread.join()


LARGEST_BODY = 4096
_SILENT_S = 10.0
"""A connection without a request for so long is closed (s)."""
_SWITCH_S = 5e-4
"""The thread of an order waits no longer than this for each thread that makes an answer (s)."""

_PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/scope.js": ("scope.js", "text/javascript; charset=utf-8"),
    "/signal.js": ("signal.js", "text/javascript; charset=utf-8"),
    "/bench.js": ("bench.js", "text/javascript; charset=utf-8"),
    "/goto.js": ("goto.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/uplot.js": ("uplot.js", "text/javascript; charset=utf-8"),
    "/uplot.css": ("uplot.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def serve_page(socket: Path, port: int, *, allow_control: bool) -> None:
    """Serve until Ctrl-C; print the address. Raises `OSError` where the port is taken."""
    token = secrets.token_urlsafe(24) if allow_control else ""
    server = PageServer(socket, port, token)
    sys.setswitchinterval(_SWITCH_S)
    print(f"http://127.0.0.1:{server.server_port}/{'#' + token if token else ''}", flush=True)
    how = "this address lets you stop and move the muscle" if token else "read-only"
    print(f"pamctl watch: {how}; Ctrl-C ends it", file=sys.stderr, flush=True)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.server_close()


class PageServer(ThreadingHTTPServer):
    """Listens on the loopback address; a thread for each connection."""

    daemon_threads = True
    request_queue_size = 32

    def __init__(self, socket: Path, port: int, token: str) -> None:
        """Begin to look at the daemon behind `socket`; without a `token` the page is read-only."""
        self.broadcast = Broadcast(socket)  # first: `server_close` ends both if the port is taken
        self.orders = PageOrders(socket)
        super().__init__(("127.0.0.1", port), _Handler)
        self.token = token
        self.pages = {at: _read_part(name) for at, (name, _) in _PAGE.items()}
        self.name = secrets.token_urlsafe(6)
        """Tells a page that another server answers now, which counts its looks anew."""
        self.hosts = {f"{name}:{self.server_port}" for name in ("127.0.0.1", "localhost")}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report errors, except those of browsers that went away."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

    def server_close(self) -> None:
        """Stop looking at the daemon, and take no more orders."""
        super().server_close()
        self.broadcast.end()
        self.orders.end()


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "pamctl", ""
    timeout = _SILENT_S
    wbufsize = -1  # head and body leave together
    disable_nagle_algorithm = True
    server: PageServer

    def do_GET(self) -> None:
        try:
            self._require_own_page()
            if self.path.startswith("/news?"):
                self._answer(HTTPStatus.OK, self._collect_news(), "application/json")
            elif self.path.startswith("/scope/"):
                asked = urlsplit(self.path)
                query = {name: values[0] for name, values in parse_qs(asked.query).items()}
                body, kind = self.server.broadcast.scope.answer(asked.path, query)
                self._answer(HTTPStatus.OK, body, kind)
            elif self.path == "/bench":
                self._answer_json(describe_bench(self.server.broadcast.newest_status()))
            elif self.path == "/runs":
                self._answer_json(list_runs(self.server.broadcast.newest_status()))
            elif self.path in _PAGE:
                self._answer(HTTPStatus.OK, self.server.pages[self.path], _PAGE[self.path][1])
            else:
                raise PageRefusal("there is no such page", HTTPStatus.NOT_FOUND)
        except PageRefusal as refusal:
            self._refuse(refusal)

    def do_POST(self) -> None:
        try:
            self._require_own_page()
            if self.path != "/do":
                raise PageRefusal("there is no such page", HTTPStatus.NOT_FOUND)
            status, outcome = self._give_order(self._read_order())
            self._answer(status, json.dumps(outcome).encode(), "application/json")
        except PageRefusal as refusal:
            self._refuse(refusal)

    # --- who may ask what ------------------------------------------------------------------

    def _require_own_page(self) -> None:
        """Refuse other sites: those that use our address as theirs, and cross-site requests."""
        if self.headers.get("Host") not in self.server.hosts:
            raise PageRefusal("this is not the host you asked for", HTTPStatus.MISDIRECTED_REQUEST)
        origin = self.headers.get("Origin")
        if origin is not None and origin.removeprefix("http://") not in self.server.hosts:
            raise PageRefusal("other sites may not ask here", HTTPStatus.FORBIDDEN)
        if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            raise PageRefusal("other sites may not ask here", HTTPStatus.FORBIDDEN)

    def _read_order(self) -> dict[str, Any]:
        """Read an order; raise `PageRefusal` if it is not permitted or not understood."""
        body = self._read_body()
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        is_known = hmac.compare_digest(token.encode(), self.server.token.encode())
        order = _parse_order(body)
        if not self.server.token:
            raise PageRefusal("read-only: start it with --allow-control", HTTPStatus.FORBIDDEN)
        if not is_known:
            raise PageRefusal(
                "open the page by its whole address, with #...", HTTPStatus.UNAUTHORIZED
            )
        return order

    def _read_body(self) -> bytes:
        if self.headers.get_content_type() != "application/json":
            raise PageRefusal("an order is application/json", HTTPStatus.UNSUPPORTED_MEDIA_TYPE)
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal()):
            raise PageRefusal("an order has a length", HTTPStatus.LENGTH_REQUIRED)
        digits = length.lstrip("0") or "0"
        if len(digits) > len(str(LARGEST_BODY)) or int(digits) > LARGEST_BODY:
            raise PageRefusal(f"at most {LARGEST_BODY} bytes", HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        return self.rfile.read(int(digits))

    def _give_order(self, order: dict[str, Any]) -> tuple[HTTPStatus, dict[str, Any]]:
        number = self.server.orders.give(*translate_order(order))
        if number is None:
            return HTTPStatus.OK, {}
        return HTTPStatus.ACCEPTED, {"order": number}

    # --- answers -----------------------------------------------------------------------------

    def _collect_news(self) -> bytes:
        """Return what came after the look that the page names, or all where it names none."""
        asked = parse_qs(urlsplit(self.path).query)
        after = asked.get("after", ["0"])[0]
        is_known = asked.get("server") == [self.server.name] and after.isascii()
        seen = int(after) if is_known and after.isdecimal() and len(after) < 16 else 0
        news = {
            "server": self.server.name,
            "control": bool(self.server.token),
            "orders": self.server.orders.outcomes(),
        }
        return self.server.broadcast.encode_news(seen, news)

    def _answer_json(self, document: object) -> None:
        self._answer(HTTPStatus.OK, json.dumps(document).encode(), "application/json")

    def _answer(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self._begin(status, kind, len(body))
        self.wfile.write(body)

    def _refuse(self, refusal: PageRefusal) -> None:
        self.close_connection = True  # the body may not have been read
        body = json.dumps({"error": str(refusal)}).encode()
        with suppress(ConnectionError, TimeoutError):
            self._answer(refusal.status, body, "application/json")

    def _begin(self, status: HTTPStatus, kind: str, length: int) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(length))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Write no line for each request."""


def _read_part(name: str) -> bytes:
    if name.startswith("uplot"):
        return (files("pamctl.report") / "uplot").joinpath(name).read_bytes()
    own = (files("pamctl.live") / "page").joinpath(name).read_bytes()
    return COLOURS.encode() + own if name == "page.css" else own


def _parse_order(body: bytes) -> dict[str, Any]:
    try:
        order = json.loads(body)
    except (ValueError, RecursionError):
        raise PageRefusal("not JSON") from None
    if not isinstance(order, dict):
        raise PageRefusal('an order is {"do": ...}')
    return order
