"""The live page: the body in the browser while the person moves, served to this machine only.

meshcat's own server listens on every interface and queues what a slow browser has not taken. So the page carries
meshcat's viewer inside and gets frames through a WebSocket of ours: a browser that has not drawn its last frame gets
none, and then the newest.

``/stream`` is a WebSocket, little endian. The browser answers each message with the text ``taken`` when it is drawn;
until then no other comes.

- Text: ``{"id": …}`` once (another id means another page to load); then each `state.Status` as JSON, five times a
  second, in a guided session ten times, with its instructions under ``guide``, and under ``angles`` the joint angles in
  degrees since the status before, with their times.
- Binary: time (float64, NaN before the start); for each link its rotation row by row and its position [m] (12 float32);
  the points whose paths are drawn (3 float32 each); for each link whether its sensor is lost (1 byte). The names of the
  links are in the page; those of a robot come last.
- To the server: ``taken``, and each `state.Request` as a JSON object, such as ``{"action": "text", "text": "box"}``. It
  answers only under an address or ``localhost``, and a WebSocket only from its own page.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import hmac
import json
import re
import secrets
import socket
import threading
from collections import deque
from collections.abc import Mapping
from ipaddress import IPv4Address
from typing import Any

import numpy as np
from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ..body import BodyModel
from ..body.links import find_known_points
from ..errors import BadOption
from ..report.viewer import DARK, LIGHT, backdrop, choose_trail_colour, filled, find_floor, scene, view
from .encoder import PoseEncoder, RobotFigure, place_n_pose
from .sources.udp import LOOPBACK, name_host
from .state import QUIT, LivePose, Output, Request, Status, StreamInfo, round_finite

FINGERS = 0.1  # [m] beyond the end of a limb
DIRECTIONS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.6, 0.8]])
MAX_REQUESTS = 16  # not yet taken; more are dropped
FRAME_S = 1.0 / 60.0
MAX_BYTES = 1024  # of a message from the page
PING_S, PONG_S = 5.0, 4.0
GOODBYE_S = 0.5  # that a browser has to answer when the page ends
DIGITS = 6  # after the point
HEADERS = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}


class LivePage(Output):
    """Serves the page from `open` to `close`, from a thread of its own.

    Parameters
    ----------
    model : the body, with its lengths
    host : address to listen on; another than loopback lets others in the network watch and press keys, who know the
        token in `url`
    port : 0 for any free one
    title : shown above the body
    """

    def __init__(self, model: BodyModel, host: str = LOOPBACK, port: int = 0, title: str = "") -> None:
        self.host, self._port, self._title = host, port, title
        self.url = ""  # of an open page
        self.token = ""  # that the address must have; empty: none
        self.newest_status: Status | None = None
        self.clients: set[Stream] = set()
        self.requests: deque[Request] = deque(maxlen=MAX_REQUESTS)
        self._encoded: tuple[Status | None, str] = None, ""  # the newest status that was sent, and as what
        self._closing, self._thread = threading.Event(), threading.Thread()
        self.set_body(model)

    def open(self) -> None:
        """Serve the page; raises `BadOption` where the address is not this machine's, or the port is taken."""
        host, port = self.host, self._port
        if not host or not 0 <= port < 65536:  # without a host the system would take every interface
            raise BadOption(f"the live page at {host}:{port}: an address and a port from 1 to 65535, or 0, are needed")
        try:
            listening = socket.create_server((host, port), backlog=16)
        except OSError as error:
            raise BadOption(
                f"the live page cannot listen on {host}:{port}: {error.strerror}; another port, or 0 for any that is "
                f"free"
            ) from None
        listening.setblocking(False)
        self.token = "" if host in (LOOPBACK, "localhost") else secrets.token_urlsafe(16)
        self.url = f"http://{name_host(host)}:{listening.getsockname()[1]}/"
        self.url += f"?token={self.token}" if self.token else ""
        serve = lambda: asyncio.run(self._serve(listening))  # noqa: E731
        self._thread = threading.Thread(target=serve, name="live page", daemon=True)
        self._thread.start()

    def set_body(self, model: BodyModel, robot: RobotFigure | None = None) -> None:
        """Draw this body from now on, and a robot beside it; open browsers load the page again."""
        encoder = PoseEncoder(model, robot)
        self.html = _fill_page(model, encoder, self._title)
        self.encoder = encoder

    def demonstrate(self, pose: LivePose, info: StreamInfo) -> None:
        if self.encoder.info is not info:
            self.start(info)
        self.encoder.newest = pose

    def start(self, info: StreamInfo) -> None:
        self.encoder.start(info)

    def show(self, pose: LivePose) -> None:
        """Take the newest pose; it is drawn when a browser is ready for it. Costs less than a microsecond."""
        self.encoder.show(pose)

    def status(self, status: Status) -> None:
        self.newest_status = status

    def take_requests(self) -> list[Request]:
        return [self.requests.popleft() for _ in range(len(self.requests))]

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    async def _serve(self, listening: socket.socket) -> None:
        application = Application(
            [("/", Page, {"page": self}), ("/stream", Stream, {"page": self})],
            log_function=lambda _handler: None,
            websocket_ping_interval=PING_S,
            websocket_ping_timeout=PONG_S,
            websocket_max_message_size=MAX_BYTES,
        )
        server = HTTPServer(application, max_header_size=16384)
        server.add_socket(listening)
        while not self._closing.is_set():
            self._send_newest()
            await asyncio.sleep(FRAME_S)
        server.stop()
        for client in list(self.clients):
            if self.newest_status is not None:
                client.send(self._encode_status(self.newest_status))
            client.close(1001, "ended")
        for _ in range(int(GOODBYE_S / 0.01)):
            if self.clients:
                await asyncio.sleep(0.01)
        await server.close_all_connections()

    def _send_newest(self) -> None:
        """Send what is new to every browser that has drawn what it got."""
        encoder, status = self.encoder, self.newest_status
        pose, frame = encoder.newest, b""
        drawn = encoder.info if pose is None else pose  # without a pose that of the start is drawn
        for client in [client for client in self.clients if client.pending == 0]:
            if client.encoder is not encoder:  # it loads the new page
                client.greet()
                continue
            if status is not None and client.status is not status:
                client.status = status
                client.send(self._encode_status(status))
            if client.drawn is not drawn:
                client.drawn = drawn
                frame = frame or encoder.encode(pose)
                client.send(frame)

    def _encode_status(self, status: Status) -> str:
        """A status and the joint angles since the one before as JSON: its fields, null for what is not known."""
        if self._encoded[0] is not status:
            fields = _to_json(status) | {"angles": self.encoder.take_angles()}
            self._encoded = status, json.dumps(fields, allow_nan=False)
        return self._encoded[1]


class Guarded(RequestHandler):  # type: ignore[misc]
    """Answers only who knows the page by its address and token."""

    def initialize(self, page: LivePage) -> None:
        self.page = page

    def prepare(self) -> None:
        host, origin, token = self.request.host, self.request.headers.get("Origin"), self.page.token
        if not _is_address(host, self.page.host):
            raise HTTPError(403, reason="This page is known by address, or as localhost.")
        if origin is not None and origin != f"http://{host}":
            raise HTTPError(403, reason="This page speaks to itself only.")
        if token and not hmac.compare_digest(self.get_query_argument("token", "").encode(), token.encode()):
            raise HTTPError(403, reason="The address of this page has a token, as the terminal shows it.")

    def set_default_headers(self) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value)

    def write_error(self, status_code: int, **_: Any) -> None:  # noqa: ARG002
        self.finish(self._reason)


class Page(Guarded):
    """The page, which may run its own scripts and connect to its own server."""

    def get(self) -> None:
        html = self.page.html
        scripts = re.findall(r"<script>(.*?)</script>", html, flags=re.DOTALL)
        digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
        own = " ".join(f"'sha256-{digest}'" for digest in digests)
        # meshcat's viewer creates style elements when it starts and fails without them.
        self.set_header(
            "Content-Security-Policy",
            f"default-src 'none'; script-src {own}; style-src 'unsafe-inline'; img-src data:; "
            f"connect-src ws://{self.request.host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        )
        self.finish(html)


class Stream(Guarded, WebSocketHandler):  # type: ignore[misc]
    """The connection to one browser."""

    def initialize(self, page: LivePage) -> None:
        super().initialize(page)
        self.pending = 0  # messages that the browser has not drawn yet
        self.encoder: PoseEncoder | None = None  # what was sent last, as the next two
        self.status: Status | None = None
        self.drawn: object = self  # nothing

    def open(self, *_: str, **__: str) -> None:
        self.page.clients.add(self)
        self.greet()

    def greet(self) -> None:
        self.encoder = self.page.encoder
        self.send(json.dumps({"id": self.encoder.identity}))

    def on_message(self, message: str | bytes) -> None:
        if message == "taken":
            self.pending = max(0, self.pending - 1)
        elif isinstance(message, str):
            request = Request.parse(message)
            if request is not None and request.action != QUIT.action:  # who watches does not end the session
                self.page.requests.append(request)

    def on_close(self) -> None:
        self.page.clients.discard(self)

    def send(self, message: str | bytes) -> None:
        self.pending += 1
        try:
            sent = self.write_message(message, binary=isinstance(message, bytes))
        except WebSocketClosedError:
            self.page.clients.discard(self)
        else:  # a browser that leaves during the transfer is no error
            sent.add_done_callback(lambda done: done.cancelled() or done.exception())


def _is_address(host: str, own: str) -> bool:
    """Whether the Host of a request is an address, localhost, or the host that was asked for.

    The name of a foreign page may resolve to 127.0.0.1, and its scripts would then be of our origin.
    """
    name = re.sub(r":[0-9]{1,5}$", "", host.lower())
    with contextlib.suppress(ValueError):
        return name in ("localhost", own.lower()) or bool(IPv4Address(name))
    return False


def _fill_page(model: BodyModel, encoder: PoseEncoder, title: str) -> str:
    """The page; its scene is the body in the N-pose, its camera sees all that the limbs can reach."""
    links, body, robot = encoder.links, encoder.body_links, encoder.robot
    neutral = np.frombuffer(encoder.encode(None), "<f4", 12 * len(body), offset=8).reshape(-1, 12)
    motion = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(body), 1, 1)).astype("<f4")
    motion[:, 0, 4:] = neutral[:, 9:]
    floor, reach, data = find_floor(model), [np.zeros((1, 3))], place_n_pose(model)
    known = find_known_points(model, model.chains)
    p_W = {point: data.oMf[model.pin.getFrameId(model.point_frames[point])].translation for point in known}
    for first, *_, last in model.table.draw.limbs:  # in front, at the sides and up
        if last in model.table.draw.paths and first in p_W and last in p_W:
            reach.append(p_W[first] + (np.linalg.norm(p_W[last] - p_W[first]) + FINGERS) * DIRECTIONS)
    if robot is not None:
        reach.append(robot.points())
    content = {
        "id": encoder.identity,
        "links": list(links),
        "scene": scene(encoder.visuals, links, () if robot is None else robot.meshes),
        "backdrops": {name: backdrop(colours, floor) for name, colours in (("light", LIGHT), ("dark", DARK))},
        "view": view(encoder.visuals, body, motion, reach),
        "trails": [{"name": hand, "colour": choose_trail_colour(hand, model)} for hand in model.table.draw.paths],
    }
    return filled("live/templates/live.html.j2", content, title or "wepose live")


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
