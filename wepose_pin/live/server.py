"""The server of the live page: HTTP and a WebSocket."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import hmac
import json
import re
import socket
import threading
from collections import deque
from collections.abc import Mapping
from ipaddress import ip_address
from typing import Any, NamedTuple

from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ..errors import BadOption
from .addresses import name_host
from .encoder import PoseEncoder
from .state import QUIT, Request, Status, round_finite

FRAME_S = 1.0 / 60.0
MAX_BYTES = 1024  # of a message from the page
PING_S, PONG_S = 5.0, 4.0
GOODBYE_S = 0.5  # that a browser has to answer when the page ends
DIGITS = 6  # after the point
HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Content(NamedTuple):
    """What the server shows: a page, and what draws its frames."""

    page: str  # HTML
    identity: str  # of this page; a browser that reconnects with another one reloads
    encoder: PoseEncoder


class Server:
    """HTTP and WebSocket in a thread with its own event loop.

    The address must have the `token`, unless that is empty; `requests` receives what is asked for in the page. Raises
    `BadOption` where the address is not this machine's, or the port is taken.
    """

    def __init__(self, content: Content, host: str, port: int, token: str, requests: deque[Request]) -> None:
        self.content, self.requests, self.token, self._host = content, requests, token, host
        self.status: Status | None = None
        self.clients: set[Stream] = set()
        self._encoded: tuple[Status | None, str] = None, ""  # the newest status that was sent, and as what
        if not host or not 0 <= port < 65536:  # without a host the system would take every interface
            raise BadOption(f"the live page at {host}:{port}: an address and a port from 1 to 65535, or 0, are needed")
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.create_server((host, port), family=family, backlog=16)
        except OSError as error:
            raise BadOption(
                f"the live page cannot listen on {host}:{port}: {error.strerror}; another port, or 0 for any that is "
                f"free"
            ) from None
        self._socket.setblocking(False)
        port = int(self._socket.getsockname()[1])
        self.url = f"http://{name_host(host)}:{port}/" + (f"?token={token}" if token else "")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="live page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()

    async def _serve(self) -> None:
        application = Application(
            [("/", Page, {"server": self}), ("/stream", Stream, {"server": self})],
            log_function=lambda _handler: None,
            websocket_ping_interval=PING_S,
            websocket_ping_timeout=PONG_S,
            websocket_max_message_size=MAX_BYTES,
        )
        server = HTTPServer(application, max_header_size=16384)
        server.add_socket(self._socket)
        while not self._closing.is_set():
            self._send_newest()
            await asyncio.sleep(FRAME_S)
        server.stop()
        for client in list(self.clients):
            if self.status is not None:
                client.send(self._encode_status(self.status))
            client.close(1001, "ended")
        for _ in range(int(GOODBYE_S / 0.01)):
            if self.clients:
                await asyncio.sleep(0.01)
        await server.close_all_connections()

    def _send_newest(self) -> None:
        """Send what is new to every browser that has drawn what it got."""
        content, status = self.content, self.status
        pose, frame = content.encoder.newest, b""
        drawn = content.encoder.info if pose is None else pose  # without a pose that of the start is drawn
        for client in [client for client in self.clients if client.pending == 0]:
            if client.content is not content:  # it loads the new page
                client.greet()
                continue
            if status is not None and client.status is not status:
                client.status = status
                client.send(self._encode_status(status))
            if client.drawn is not drawn:
                client.drawn = drawn
                frame = frame or content.encoder.encode(pose)
                client.send(frame)

    def _encode_status(self, status: Status) -> str:
        """A status and the joint angles since the one before as JSON: its fields, null for what is not known."""
        if self._encoded[0] is not status:
            fields = _to_json(status) | {"angles": self.content.encoder.angles.take()}
            self._encoded = status, json.dumps(fields, allow_nan=False)
        return self._encoded[1]

    def accepts_host(self, host: str) -> bool:
        """Whether the Host of a request is an address, localhost, or the host that was asked for.

        The name of a foreign page may resolve to 127.0.0.1, and its scripts would then be of our origin.
        """
        parts = re.fullmatch(r"\[([0-9a-f:.]+)\]|([\w.-]+)", re.sub(r":\d{1,5}$", "", host.lower()), flags=re.ASCII)
        name = (parts[1] or parts[2]) if parts else ""
        with contextlib.suppress(ValueError):
            return name in ("localhost", self._host.lower()) or bool(ip_address(name))
        return False


class Guarded(RequestHandler):  # type: ignore[misc]
    """Answers only who knows the page by its address and token."""

    def initialize(self, server: Server) -> None:
        self.server = server

    def prepare(self) -> None:
        host, origin, token = self.request.host, self.request.headers.get("Origin"), self.server.token
        if not self.server.accepts_host(host):
            raise HTTPError(403, reason="This page is known by address, or as localhost.")
        if origin is not None and origin != f"http://{host}":
            raise HTTPError(403, reason="This page speaks to itself only.")
        if token and not hmac.compare_digest(self.get_query_argument("token", "").encode(), token.encode()):
            raise HTTPError(403, reason="The address of this page has a token, as the terminal shows it.")

    def write_error(self, status_code: int, **_: Any) -> None:  # noqa: ARG002
        self.finish(self._reason)


class Page(Guarded):
    """The page, which may run its own scripts and connect to its own server."""

    def get(self) -> None:
        page = self.server.content.page
        scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
        digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
        own = " ".join(f"'sha256-{digest}'" for digest in digests)
        # meshcat's viewer creates style elements when it starts and fails without them.
        policy = (
            f"default-src 'none'; script-src {own}; style-src 'unsafe-inline'; img-src data:; "
            f"connect-src ws://{self.request.host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        for name, value in {**HEADERS, "Content-Security-Policy": policy}.items():
            self.set_header(name, value)
        self.finish(page)


class Stream(Guarded, WebSocketHandler):  # type: ignore[misc]
    """The connection to one browser."""

    def initialize(self, server: Server) -> None:
        super().initialize(server)
        self.pending = 0  # messages that the browser has not drawn yet
        self.content: Content | None = None  # what was sent last, as the next two
        self.status: Status | None = None
        self.drawn: object = self  # nothing

    def open(self, *_: str, **__: str) -> None:
        self.server.clients.add(self)
        self.greet()

    def greet(self) -> None:
        self.content = self.server.content
        self.send(json.dumps({"id": self.content.identity}))

    def on_message(self, message: str | bytes) -> None:
        if message == "taken":
            self.pending = max(0, self.pending - 1)
        elif isinstance(message, str):
            request = Request.parse(message)
            if request is not None and request.action != QUIT.action:  # who watches does not end the session
                self.server.requests.append(request)

    def on_close(self) -> None:
        self.server.clients.discard(self)

    def send(self, message: str | bytes) -> None:
        self.pending += 1
        try:
            sent = self.write_message(message, binary=isinstance(message, bytes))
        except WebSocketClosedError:
            self.server.clients.discard(self)
        else:  # a browser that leaves during the transfer is no error
            sent.add_done_callback(lambda done: done.cancelled() or done.exception())


def _to_json(value: Any) -> Any:
    """What JSON holds of a value; named tuples as objects, null for a number that is not known."""
    if isinstance(value, float):
        return round_finite(value, DIGITS)
    if isinstance(value, Mapping):
        return {key: _to_json(item) for key, item in value.items()}
    if isinstance(value, tuple):
        names = getattr(value, "_fields", None)
        items = [_to_json(item) for item in value]
        return items if names is None else dict(zip(names, items, strict=True))
    return value
