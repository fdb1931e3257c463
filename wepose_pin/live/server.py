"""The server of the live page: HTTP and a WebSocket."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import json
import re
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.web import Application, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ..errors import BadOption
from .addresses import name_host
from .encoder import PoseEncoder
from .state import Request, Status, round_finite

FRAME_S = 1.0 / 60.0
MAX_CLIENTS = 16
MAX_BYTES = 1024  # of a message from the page
PING_S, PONG_S = 5.0, 4.0
CURVES_S = 0.4  # between joint angles
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


@dataclass(frozen=True)
class Content:
    """What the server shows: a page, and what draws its frames.

    Parameters
    ----------
    page : HTML
    identity : of this page; a browser that reconnects with another one reloads
    """

    page: str
    identity: str
    encoder: PoseEncoder

    @property
    def scripts(self) -> str:
        """The digests of the page's own scripts."""
        scripts = re.findall(r"<script>(.*?)</script>", self.page, flags=re.DOTALL)
        digests = [base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()) for script in scripts]
        return " ".join(f"'sha256-{digest.decode('ascii')}'" for digest in digests)


class Server:
    """HTTP and WebSocket in a thread with its own event loop.

    Parameters
    ----------
    token : that the address must have; empty: none is needed
    requests : receives what is asked for in the page

    Attributes
    ----------
    content, status : shown now
    clients : open WebSockets

    Raises
    ------
    BadOption
        The address is not this machine's, or the port is taken.
    """

    def __init__(self, content: Content, host: str, port: int, token: str, requests: deque[Request]) -> None:
        self.content, self.requests, self.token, self._host = content, requests, token, host
        self.status: Status | None = None
        self.clients: set[Stream] = set()
        self._curves, self._curves_due = "", 0.0
        if not host:  # to the system that would be every interface
            raise BadOption("the live page needs an address to listen on; 127.0.0.1 is this machine only")
        if not 0 <= port < 65536:
            raise BadOption(f"the live page: port {port}; a number from 1 to 65535, or 0 for any that is free")
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.create_server((host, port), family=family, backlog=16)
        except OSError as error:
            raise BadOption(
                f"the live page cannot listen on {host}:{port}: {error.strerror}; "
                f"another port, or 0 for any that is free"
            ) from None
        self._socket.setblocking(False)
        port = int(self._socket.getsockname()[1])
        self.url = f"http://{name_host(host)}:{port}/" + (f"?token={token}" if token else "")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="live page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Tell the browsers, and free the port."""
        self._closing.set()
        self._thread.join()

    async def _serve(self) -> None:
        handlers = [("/", Page, {"server": self}), ("/stream", Stream, {"server": self})]
        application = Application(
            handlers,
            log_function=lambda _handler: None,
            websocket_ping_interval=PING_S,
            websocket_ping_timeout=PONG_S,
            websocket_max_message_size=MAX_BYTES,
        )
        server = HTTPServer(application, max_header_size=16384)
        server.add_socket(self._socket)
        time = asyncio.get_running_loop().time
        due = time()
        while not self._closing.is_set():
            self._send_newest(time())
            due = max(due + FRAME_S, time())
            await asyncio.sleep(max(due - time(), 0.001))
        server.stop()
        for client in list(self.clients):
            client.say_goodbye()
        until = time() + GOODBYE_S
        while self.clients and time() < until:
            await asyncio.sleep(0.01)
        await server.close_all_connections()

    def _send_newest(self, now: float) -> None:
        """Send what is new to every browser that has drawn what it got."""
        ready = [client for client in self.clients if client.pending == 0]
        if not ready:
            return
        content, status = self.content, self.status
        encoder = content.encoder
        if now >= self._curves_due:
            self._curves_due = now + CURVES_S
            curves = encoder.angles.take()
            self._curves = self._curves if curves is None else json.dumps({"angles": curves}, allow_nan=False)
        pose, curves_text = encoder.newest, self._curves
        messages: dict[str, tuple[Any, Callable[[], str | bytes]]] = {  # kind → what it is made of, and how
            "status": (status, lambda: status_json(status)),
            "curves": (curves_text, lambda: curves_text),
            "pose": (pose or encoder.measured or encoder, lambda: encoder.encode(pose)),
        }
        encoded: dict[str, str | bytes] = {}
        for client in ready:
            if client.sent.get("content") is not content:  # it loads the new page
                client.greet()
                continue
            for kind, (source, encode) in messages.items():
                if source and client.sent.get(kind) is not source:
                    if kind not in encoded:
                        encoded[kind] = encode()
                    client.send(encoded[kind])
                    client.sent[kind] = source

    def accepts_host(self, host: str) -> bool:
        """Whether the Host of a request is an address, localhost, or the host that was asked for.

        The name of a foreign page may resolve to 127.0.0.1, and its scripts would then be of our origin.
        """
        parts = re.fullmatch(r"(?:\[([0-9a-f:.]+)\]|([\w.-]+))(?::\d{1,5})?", host.lower(), flags=re.ASCII)
        if parts is None:
            return False
        name = parts[1] or parts[2]
        if name in ("localhost", self._host.lower()):
            return True
        try:
            ip_address(name)
        except ValueError:
            return False
        return True


class Guarded(RequestHandler):  # type: ignore[misc]
    """Answers only who knows the page by its address and token."""

    def initialize(self, server: Server) -> None:
        self.server = server

    def prepare(self) -> None:
        host, origin, token = self.request.host, self.request.headers.get("Origin"), self.server.token
        if not self.server.accepts_host(host):
            self._refuse("This page is known by address, or as localhost.")
        elif origin is not None and origin != f"http://{host}":
            self._refuse("This page speaks to itself only.")
        elif token and not hmac.compare_digest(self.get_query_argument("token", "").encode(), token.encode()):
            self._refuse("The address of this page has a token, as the terminal shows it.")

    def _refuse(self, reason: str) -> None:
        self.set_status(403)
        self.finish(reason)


class Page(Guarded):
    """The page, which may run its own scripts and connect to its own server."""

    def set_default_headers(self) -> None:
        self.clear_header("Server")

    def get(self) -> None:
        content = self.server.content
        # meshcat's viewer creates style elements when it starts and fails without them.
        policy = (
            f"default-src 'none'; script-src {content.scripts}; style-src 'unsafe-inline'; img-src data:; "
            f"connect-src ws://{self.request.host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        for name, value in {**HEADERS, "Content-Security-Policy": policy}.items():
            self.set_header(name, value)
        self.finish(content.page.encode("utf-8"))


class Stream(Guarded, WebSocketHandler):  # type: ignore[misc]
    """The connection to one browser.

    Attributes
    ----------
    pending : messages that the browser has not drawn yet
    sent : kind of message → what was sent last
    """

    def initialize(self, server: Server) -> None:
        super().initialize(server)
        self.pending, self.sent = 0, dict[str, Any]()

    def open(self, *_: str, **__: str) -> None:
        if len(self.server.clients) >= MAX_CLIENTS:
            self.close(1013, "too many pages are open")
            return
        self.server.clients.add(self)
        self.greet()

    def greet(self) -> None:
        """Say which page is shown."""
        self.sent["content"] = self.server.content
        self.send(json.dumps({"id": self.server.content.identity}))

    def on_message(self, message: str | bytes) -> None:
        if message == "taken":
            self.pending = max(0, self.pending - 1)
        elif isinstance(message, str):
            request = Request.parse(message)
            if request is not None and request.kind != "quit":  # who watches does not end the session
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

    def say_goodbye(self) -> None:
        """Send the last status, and close."""
        if self.server.status is not None:
            self.send(status_json(self.server.status))
        self.close(1001, "ended")


def status_json(status: Status | None) -> str:
    """A status for the page, as an object with the fields' names; null for what is not known."""
    return json.dumps(_to_json(status), allow_nan=False)


def _to_json(value: Any) -> Any:
    if isinstance(value, float):
        return round_finite(value, DIGITS)
    if isinstance(value, dict):
        return {key: _to_json(item) for key, item in value.items()}
    if isinstance(value, tuple):
        names = getattr(value, "_fields", None)
        items = [_to_json(item) for item in value]
        return items if names is None else dict(zip(names, items, strict=True))
    return value
