"""The server of the live page: HTTP and a WebSocket."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import json
import math
import re
import socket
import threading
from collections import deque
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any

from ..errors import BadOption
from .addresses import name_host
from .encoder import PoseEncoder
from .state import GuideView, Status, format_heading_std, name_length, round_finite

FRAME_S = 1.0 / 60.0
MAX_ACTION = 120  # letters of an action
MAX_CLIENTS = 16
MAX_BYTES = 256  # of a message from the page
PING_S, PONG_S = 5.0, 4.0
CURVES_S = 0.4  # between joint angles
GOODBYE_S = 0.5  # that a browser has to answer when the page ends


@dataclass(frozen=True)
class ServerOptions:
    """A page and its address.

    Parameters
    ----------
    page : HTML
    identity : of this page; a browser that reconnects with another one reloads
    token : that the address must have; empty: none is needed
    """

    page: str
    identity: str
    host: str
    port: int
    token: str = ""


class Server:
    """HTTP and WebSocket in a thread with its own event loop.

    Parameters
    ----------
    keys : receives the keys pressed in the page

    Raises
    ------
    BadOption
        The address is not this machine's, or the port is taken.
    """

    def __init__(self, options: ServerOptions, encoder: PoseEncoder, keys: deque[str]) -> None:
        host, port = options.host, options.port
        self.status: Status | None = None
        self._encoder, self._keys, self._host, self.token = encoder, keys, host, options.token
        self._clients: set[Any] = set()
        self._curves, self._curves_due = "", 0.0
        self.set_page(options, encoder)
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
        self.port = int(self._socket.getsockname()[1])
        self.url = f"http://{name_host(host)}:{self.port}/" + (f"?token={self.token}" if self.token else "")
        self._loop = asyncio.new_event_loop()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="live page", daemon=True)

    def set_page(self, options: ServerOptions, encoder: PoseEncoder) -> None:
        """Serve this page from now on; browsers that show another one learn of it and load it."""
        scripts = re.findall(r"<script>(.*?)</script>", options.page, flags=re.DOTALL)
        digests = [hashlib.sha256(script.encode("utf-8")).digest() for script in scripts]
        self._scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
        self.page, self._encoder = options.page.encode("utf-8"), encoder
        self.hello = json.dumps({"id": options.identity})

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        if self._thread.is_alive():
            self._closing = True
            self._thread.join()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.run_until_complete(self._loop.shutdown_asyncgens())
            asyncio.set_event_loop(None)
            self._loop.close()

    async def _serve(self) -> None:
        from tornado.httpserver import HTTPServer

        server = HTTPServer(_build_application(self), max_header_size=16384)
        server.add_socket(self._socket)
        due = self._loop.time()
        while not self._closing:
            self._send_newest()
            due = max(due + FRAME_S, self._loop.time())
            await asyncio.sleep(max(due - self._loop.time(), 0.001))
        server.stop()
        for client in list(self._clients):
            client.say_goodbye(self.status)
        until = self._loop.time() + GOODBYE_S
        while self._clients and self._loop.time() < until:
            await asyncio.sleep(0.01)
        await server.close_all_connections()

    def _send_newest(self) -> None:
        """Send what is new to every browser that has drawn what it got."""
        ready = [client for client in self._clients if client.pending == 0]
        if not ready:
            return
        status, pose, measured = self.status, self._encoder.newest, self._encoder.measured
        if self._loop.time() >= self._curves_due:
            self._curves_due = self._loop.time() + CURVES_S
            curves = self._encoder.angles.take()
            self._curves = self._curves if curves is None else json.dumps({"angles": curves}, allow_nan=False)
        text = frame = None
        for client in ready:
            if client.hello is not self.hello:  # it loads the new page
                client.send(self.hello)
                client.hello = self.hello
                continue
            if status is not None and client.status is not status:
                text = text or status_json(status)
                client.send(text)
                client.status = status
            if client.curves is not self._curves:
                client.send(self._curves)
                client.curves = self._curves
            if client.pose is not pose or client.measured is not measured:
                frame = frame or self._encoder.encode(pose)
                client.send(frame)
                client.pose, client.measured = pose, measured

    def add_client(self, client: Any) -> bool:
        """Add a browser; False where there are too many."""
        if len(self._clients) >= MAX_CLIENTS:
            return False
        self._clients.add(client)
        return True

    def remove_client(self, client: Any) -> None:
        self._clients.discard(client)

    def press_key(self, key: str) -> None:
        if key.isprintable() and 0 < len(key) <= MAX_ACTION:
            self._keys.append(key)

    def accepts_host(self, host: str) -> bool:
        """Whether the Host of a request is an address, localhost, or the host of the options.

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

    def accepts_token(self, token: str) -> bool:
        """Whether the address of a request has the token, where one is needed."""
        return not self.token or hmac.compare_digest(token.encode(), self.token.encode())

    def content_policy(self, host: str) -> str:
        """Content-Security-Policy: the page's own scripts, connections to its own server."""
        # meshcat's viewer creates style elements when it starts and fails without them.
        return (
            f"default-src 'none'; script-src {self._scripts}; style-src 'unsafe-inline'; img-src data:; "
            f"connect-src ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )


def _build_application(server: Server) -> Any:
    from tornado.web import Application, RequestHandler
    from tornado.websocket import WebSocketClosedError, WebSocketHandler

    def refuse(handler: RequestHandler) -> None:
        host, origin = handler.request.host, handler.request.headers.get("Origin")
        if not server.accepts_host(host):
            handler.set_status(403)
            handler.finish("This page is known by address, or as localhost.")
        elif origin is not None and origin != f"http://{host}":
            handler.set_status(403)
            handler.finish("This page speaks to itself only.")
        elif not server.accepts_token(handler.get_query_argument("token", "")):
            handler.set_status(403)
            handler.finish("The address of this page has a token, as the terminal shows it.")

    class Page(RequestHandler):  # type: ignore[misc]
        def prepare(self) -> None:
            refuse(self)

        def set_default_headers(self) -> None:
            self.clear_header("Server")

        def get(self) -> None:
            for name, value in (
                ("Content-Security-Policy", server.content_policy(self.request.host)),
                ("Cache-Control", "no-store"),
                ("Cross-Origin-Opener-Policy", "same-origin"),
                ("Cross-Origin-Resource-Policy", "same-origin"),
                ("Referrer-Policy", "no-referrer"),
                ("X-Content-Type-Options", "nosniff"),
            ):
                self.set_header(name, value)
            self.set_header("Content-Type", "text/html; charset=utf-8")
            self.finish(server.page)

    class Stream(WebSocketHandler):  # type: ignore[misc]
        pending = 0  # messages that the browser has not drawn yet
        curves: Any = ""  # that were sent
        hello = ""  # that was sent: which page it shows
        status: Status | None = None
        pose: Any = ()  # that was sent; () before the first
        measured: Any = ()

        def prepare(self) -> None:
            refuse(self)

        def open(self) -> None:
            if not server.add_client(self):
                self.close(1013, "too many pages are open")
                return
            self.send(server.hello)
            self.hello = server.hello

        def on_message(self, message: str | bytes) -> None:
            if message == "taken":
                self.pending = max(0, self.pending - 1)
            elif isinstance(message, str) and message.startswith("key "):
                server.press_key(message.removeprefix("key "))

        def on_close(self) -> None:
            server.remove_client(self)

        def send(self, message: str | bytes) -> None:
            self.pending += 1
            try:
                sent = self.write_message(message, binary=isinstance(message, bytes))
            except WebSocketClosedError:
                server.remove_client(self)
            else:  # a browser that leaves during the transfer is no error
                sent.add_done_callback(lambda done: done.cancelled() or done.exception())

        def say_goodbye(self, status: Status | None) -> None:
            if status is not None:
                self.send(status_json(status))
            self.close(1001, "ended")

    return Application(
        [("/", Page), ("/stream", Stream)],
        log_function=lambda _handler: None,
        websocket_ping_interval=PING_S,
        websocket_ping_timeout=PONG_S,
        websocket_max_message_size=MAX_BYTES,
    )


def status_json(status: Status) -> str:
    """A status for the page: degrees for radians, null for what is not known."""
    return json.dumps(
        {
            "state": status.state,
            "message": status.message,
            "progress": round_finite(status.progress, 3),
            "time": round_finite(status.time, 3),
            "sensors": [
                {
                    "segment": sensor.segment,
                    "rate_hz": round_finite(sensor.rate_hz, 1),
                    "lost": bool(sensor.lost),
                    "static": bool(sensor.static),
                    "bias_deg_s": [round_finite(math.degrees(axis), 5) for axis in sensor.gyro_bias],
                    "heading_std": format_heading_std(sensor.heading_std),
                    "heading_age_s": round_finite(sensor.heading_age, 1),
                    "missing": sensor.missing,
                    "late": sensor.late,
                    "duplicate": sensor.duplicate,
                    "frozen": bool(sensor.frozen),
                    "battery": round_finite(sensor.battery, 2),
                }
                for sensor in status.sensors
            ],
            "latency_ms": [round_finite(latency, 2) for latency in status.latency_ms],
            "recorded_s": round_finite(status.recorded_s, 1),
            "problems": dict(status.problems),
            "open_phases": list(status.open_phases),
            "guide": None if status.guide is None else _guide_json(status.guide),
        },
        allow_nan=False,
    )


def _guide_json(view: GuideView) -> dict[str, Any]:
    """The guide's view for the page: lengths in millimetres."""
    return view._asdict() | {
        "steps": [step._asdict() for step in view.steps],
        "countdown": None if view.countdown is None else round_finite(view.countdown, 1),
        "remaining": None if view.remaining is None else round_finite(view.remaining, 0),
        "progress": round_finite(view.progress, 3),
        "actions": [action._asdict() for action in view.actions],
        "lengths": [
            {"name": name, "mm": round_finite(1e3 * metres, 0), "std_mm": round_finite(1e3 * std, 1)}
            for name, metres, std in view.lengths
        ],
        "measurable_name": name_length(view.measurable),
        "sample_size": None if view.sample_size is None else [round_finite(size, 1) for size in view.sample_size],
    }
