"""The server of the live page: HTTP and a WebSocket."""

from __future__ import annotations

import asyncio
import base64
import hashlib
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
from .encoder import PoseEncoder
from .state import Status, round_finite

FRAME_S = 1.0 / 60.0
KEYS = ("r",)
MAX_CLIENTS = 16
MAX_BYTES = 256  # of a message from the page
PING_S, PONG_S = 5.0, 4.0
GOODBYE_S = 0.5  # that a browser has to answer when the page ends


@dataclass(frozen=True)
class ServerOptions:
    """A page and its address.

    Parameters
    ----------
    page : HTML
    identity : of this page; a browser that reconnects with another one reloads
    """

    page: str
    identity: str
    host: str
    port: int


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
        self._encoder, self._keys, self._host = encoder, keys, host
        self._clients: set[Any] = set()
        self.page = options.page.encode("utf-8")
        self.hello = json.dumps({"id": options.identity})
        scripts = re.findall(r"<script>(.*?)</script>", options.page, flags=re.DOTALL)
        digests = [hashlib.sha256(script.encode("utf-8")).digest() for script in scripts]
        self._scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
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
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self.port}/"
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="live page", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._end.set)
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
        while not self._end.is_set():
            self._send_newest()
            due = max(due + FRAME_S, self._loop.time())
            try:
                await asyncio.wait_for(self._end.wait(), max(due - self._loop.time(), 0.001))
            except TimeoutError:
                continue
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
        text = frame = None
        for client in ready:
            if status is not None and client.status is not status:
                text = text or status_json(status)
                client.send(text)
                client.status = status
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
        if key in KEYS:
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
                    "heading_std_deg": round_finite(math.degrees(sensor.heading_std), 2),
                    "heading_age_s": round_finite(sensor.heading_age, 1),
                    "missing": sensor.missing,
                    "late": sensor.late,
                    "duplicate": sensor.duplicate,
                    "frozen": bool(sensor.frozen),
                }
                for sensor in status.sensors
            ],
            "latency_ms": [round_finite(latency, 2) for latency in status.latency_ms],
            "recorded_s": round_finite(status.recorded_s, 1),
            "problems": dict(status.problems),
        },
        allow_nan=False,
    )
