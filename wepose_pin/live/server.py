"""Serves the live page: HTTP and a WebSocket, to this machine only unless told otherwise."""

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
from ipaddress import ip_address
from typing import Any

from ..errors import BadOption
from .figure import Figure
from .state import Status

FRAME_S = 1.0 / 60.0
KEYS = ("r",)
MOST_CLIENTS = 16
MOST_BYTES = 256  # of a message from the page
PING_S, PONG_S = 5.0, 4.0
GOODBYE_S = 0.5  # that a browser has to answer when the page ends


class Server:
    """HTTP and WebSocket in a thread with its own event loop.

    Parameters
    ----------
    page : the whole page
    identity : of this page; a browser that comes back with another one loads anew
    keys : where keys pressed in the page go

    Raises
    ------
    BadOption
        The address is not this machine's, or the port is taken.
    """

    def __init__(self, page: str, identity: str, figure: Figure, keys: deque[str], host: str, port: int) -> None:
        self.status: Status | None = None
        self._figure, self._keys, self._host = figure, keys, host
        self._clients: set[Any] = set()
        self.page = page.encode("utf-8")
        self.hello = json.dumps({"id": identity})
        scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
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

        server = HTTPServer(_application(self), max_header_size=16384)
        server.add_socket(self._socket)
        due = self._loop.time()
        while not self._end.is_set():
            self._feed()
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

    def _feed(self) -> None:
        """To every browser that has taken what it got the newest that it has not."""
        ready = [client for client in self._clients if client.awaited == 0]
        if not ready:
            return
        status, pose, staged = self.status, self._figure.newest, self._figure.staged
        words = frame = None
        for client in ready:
            if status is not None and client.status is not status:
                words = words or status_json(status)
                client.give(words)
                client.status = status
            if client.pose is not pose or client.staged is not staged:
                frame = frame or self._figure.frame(pose)
                client.give(frame)
                client.pose, client.staged = pose, staged

    def joined(self, client: Any) -> bool:
        if len(self._clients) >= MOST_CLIENTS:
            return False
        self._clients.add(client)
        return True

    def left(self, client: Any) -> None:
        self._clients.discard(client)

    def pressed(self, key: str) -> None:
        if key in KEYS:
            self._keys.append(key)

    def knows(self, host: str) -> bool:
        """Whether a request's Host is an address, this machine by name, or what the page was told to listen on.

        A foreign page can have its own name resolve to 127.0.0.1, and its scripts would then be of our origin.
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

    def policy(self, host: str) -> str:
        """The page may run its own scripts and talk to its own server."""
        # meshcat's viewer makes style elements as it starts and fails without them.
        return (
            f"default-src 'none'; script-src {self._scripts}; style-src 'unsafe-inline'; img-src data:; "
            f"connect-src ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )


def _application(server: Server) -> Any:
    from tornado.web import Application, RequestHandler
    from tornado.websocket import WebSocketClosedError, WebSocketHandler

    def refuse(handler: RequestHandler) -> None:
        host, origin = handler.request.host, handler.request.headers.get("Origin")
        if not server.knows(host):
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
                ("Content-Security-Policy", server.policy(self.request.host)),
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
        awaited = 0  # messages that the browser has not drawn yet
        status: Status | None = None
        pose: Any = ()  # what was sent; () until something was
        staged: Any = ()

        def prepare(self) -> None:
            refuse(self)

        def open(self) -> None:
            if not server.joined(self):
                self.close(1013, "too many pages are open")
                return
            self.give(server.hello)

        def on_message(self, message: str | bytes) -> None:
            if message == "taken":
                self.awaited = max(0, self.awaited - 1)
            elif isinstance(message, str) and message.startswith("key "):
                server.pressed(message.removeprefix("key "))

        def on_close(self) -> None:
            server.left(self)

        def give(self, message: str | bytes) -> None:
            self.awaited += 1
            try:
                sent = self.write_message(message, binary=isinstance(message, bytes))
            except WebSocketClosedError:
                server.left(self)
            else:  # a browser that goes away while it is sent is no error
                sent.add_done_callback(lambda done: done.cancelled() or done.exception())

        def say_goodbye(self, status: Status | None) -> None:
            if status is not None:
                self.give(status_json(status))
            self.close(1001, "ended")

    return Application(
        [("/", Page), ("/stream", Stream)],
        log_function=lambda _handler: None,
        websocket_ping_interval=PING_S,
        websocket_ping_timeout=PONG_S,
        websocket_max_message_size=MOST_BYTES,
    )


def status_json(status: Status) -> str:
    """A status for the page: degrees for radians, null for what is not known."""
    return json.dumps(
        {
            "state": status.state,
            "message": status.message,
            "progress": _rounded(status.progress, 3),
            "time": _rounded(status.time, 3),
            "sensors": [
                {
                    "segment": sensor.segment,
                    "rate_hz": _rounded(sensor.rate_hz, 1),
                    "lost": bool(sensor.lost),
                    "static": bool(sensor.static),
                    "bias_deg_s": [_rounded(math.degrees(axis), 5) for axis in sensor.gyro_bias],
                    "heading_std_deg": _rounded(math.degrees(sensor.heading_std), 2),
                    "heading_age_s": _rounded(sensor.heading_age, 1),
                    "missing": sensor.missing,
                    "late": sensor.late,
                    "duplicate": sensor.duplicate,
                    "frozen": bool(sensor.frozen),
                }
                for sensor in status.sensors
            ],
            "latency_ms": [_rounded(latency, 2) for latency in status.latency_ms],
            "recorded_s": _rounded(status.recorded_s, 1),
            "problems": dict(status.problems),
        },
        allow_nan=False,
    )


def _rounded(value: float, digits: int) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None
