"""The live page: the body in the browser while the person moves, served to this machine only.

meshcat's own server listens on every interface and queues what a slow browser has not taken. So the page carries
meshcat's viewer inside and gets frames through ``/stream``, a WebSocket of ours, little endian. The browser answers
each message with the text ``taken`` when it is drawn; until then no other comes, and then the newest.

- Text: ``{"id": …}`` once (another id means another page to load); then each `state.Status` as JSON.
- Binary: time (float64, NaN before the start); for each link its rotation row by row and its position [m] (12 float32);
  the points whose paths are drawn (3 float32 each); for each link whether its sensor is lost (1 byte). The names of the
  links are in the page; those of a robot come last.
- To the server: ``taken``, and each `state.Request` as a JSON object, such as ``{"action": "phase", "text": "box"}``.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import math
import secrets
import socket
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from ..body import BodyModel
from ..body.configuration import KinematicsSolver
from ..body.kinematics import find_known_links
from ..errors import BadOption
from ..report.viewer import choose_trail_colour, fill_page, find_floor, scene, view
from ..retargeting.targets import find_person_arm
from ..retargeting.visuals import MeshPart, build_parts, place_beside_person
from ..writers.result import as_json
from .sources.udp import LOOPBACK, name_host
from .state import LONGEST_TEXT, QUIT, LivePose, Output, Request, Status, StreamInfo

if TYPE_CHECKING:
    from .outputs import RobotOutput

LOCAL_HOSTS = (LOOPBACK, "localhost")
FINGERS = 0.1  # [m] beyond the end of a limb
DIRECTIONS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.6, 0.8]])
MAX_REQUESTS = 16  # not yet taken; more are dropped
FRAME_S = 1.0 / 60.0
MAX_BYTES = 1024  # of a message from the page
PING_S, PONG_S = 5.0, 4.0
GOODBYE_S = 0.5  # that a browser has to answer when the page ends
DIGITS = 6  # after the point
HEADERS = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY"}


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
            text = f"the live page cannot listen on {host}:{port}: {error.strerror}; another port, or 0 for a free one"
            raise BadOption(text) from None
        listening.setblocking(False)
        self.token = "" if host in LOCAL_HOSTS else secrets.token_urlsafe(16)
        self.url = f"http://{name_host(host)}:{listening.getsockname()[1]}/"
        self.url += f"?token={self.token}" if self.token else ""
        self._thread = threading.Thread(target=asyncio.run, args=(self._serve(listening),), daemon=True)
        self._thread.start()

    def set_body(self, model: BodyModel, driven: RobotOutput | None = None) -> None:
        """Draw this body from now on, and beside it the robot that is driven; browsers load the page again."""
        encoder = PoseEncoder(model, driven)
        self.html, self.encoder = _fill_page(model, encoder, self._title), encoder

    def demonstrate(self, pose: LivePose, info: StreamInfo) -> None:
        if self.encoder.info is not info:
            self.start(info)
        self.encoder.newest = pose

    def start(self, info: StreamInfo) -> None:
        self.encoder.start(info)

    def show(self, pose: LivePose) -> None:
        self.encoder.newest = pose  # it is drawn when a browser is ready for it

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
                client.send(json.dumps(as_json(self.newest_status, DIGITS), allow_nan=False))
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
                client.send(json.dumps(as_json(status, DIGITS), allow_nan=False))
            if client.drawn is not drawn:
                client.drawn = drawn
                frame = frame or encoder.encode(pose)
                client.send(frame)


class PoseEncoder:
    """Encodes poses for the page, and beside the person the robot in the posture of its newest command."""

    def __init__(self, model: BodyModel, driven: RobotOutput | None = None) -> None:
        self.identity = secrets.token_hex(8)  # of the page that draws its frames
        self.visuals = model.visuals
        self.body_links = tuple(dict.fromkeys(visual.link for visual in self.visuals))
        self.newest: LivePose | None = None  # to draw; None: the N-pose
        self.info: StreamInfo | None = None  # of the poses; None before the start
        self._model, self._lock = model, threading.Lock()  # the page encodes in a thread of its own
        self._frames = [model.pin.getFrameId(link) for link in self.body_links]
        self._known = np.ones(len(self._frames), dtype=bool)
        data = model.pin.createData()
        pin.framesForwardKinematics(model.pin, data, pin.neutral(model.pin))
        self.neutral = _stack([data.oMf[frame] for frame in self._frames])
        p_W = {point: data.oMf[model.pin.getFrameId(frame)].translation for point, frame in model.point_frames.items()}
        draw, self.reach = model.table.draw, [np.zeros((1, 3))]  # points [m] that the camera has to see
        for first, *_, last in draw.limbs:  # in front, at the sides and up
            if last in draw.paths:
                self.reach.append(p_W[first] + (np.linalg.norm(p_W[last] - p_W[first]) + FINGERS) * DIRECTIONS)
        self._driven, self._robot_joints, self.meshes = driven, list[int](), list[MeshPart]()
        if driven is not None:
            robot = driven.robot
            self.meshes = build_parts(robot)
            heights = [p_W[find_person_arm(model.table, arm.side).points[0]][2] for arm in robot.arms]
            self._root = pin.SE3(*place_beside_person(robot, float(np.mean(heights)), find_floor(model)))
            self._robot_joints = sorted({part.joint for part in self.meshes})
            self._robot_data = robot.model.createData()
            placed = dict(zip(self._robot_joints, self._place_robot(), strict=True))
            for part in self.meshes:
                self.reach.append(part.vertices @ placed[part.joint][:9].reshape(3, 3).T + placed[part.joint][9:])
        self.links = self.body_links + tuple(f"robot {joint}" for joint in self._robot_joints)  # as in the frames

    def start(self, info: StreamInfo) -> None:
        model, kinematics = self._model, KinematicsSolver(self._model, info.segments)
        known = find_known_links(model, info.segments)
        moved = {chain[-1]: segment for segment, chain in model.chains.items() if chain}
        sensors = []  # of each link the row of the sensor that places it; -1: none
        for frame in self._frames:
            joint = model.pin.frames[frame].parentJoint
            while joint and moved.get(joint) not in info.segments:
                joint = model.pin.parents[joint]
            sensors.append(info.segments.index(moved[joint]) if joint else -1)
        with self._lock:
            self._kinematics, self._placed = kinematics, [kinematics.data.oMf[frame] for frame in self._frames]
            self._known = np.array([link in known for link in self.body_links], dtype=bool)
            self._sensors = np.array(sensors, dtype=int)
            self._paths = [info.points.index(point) if point in info.points else -1 for point in model.table.draw.paths]
            self.newest, self.info = None, info  # the newest one may be of another stream

    def encode(self, pose: LivePose | None) -> bytes:
        """The frame of a pose, None: the N-pose, as `page` describes it; NaN is what is not known."""
        time, placements, lost = math.nan, self.neutral, np.zeros(len(self.links), dtype=bool)
        points = np.full((len(self._model.table.draw.paths), 3), np.nan, "<f4")
        with self._lock:
            if pose is not None and self.info is not None and len(pose.quat_WL) == len(self.info.segments):
                self._kinematics.compute_points(pose.quat_WL)
                time, placements = pose.time, _stack(self._placed)
                for k, row in enumerate(self._paths):
                    points[k] = pose.points[row] if row >= 0 else np.nan
                lost[: len(self._sensors)] = (self._sensors >= 0) & pose.lost[self._sensors]
            placements = np.where(self._known[:, None], placements, np.float32(np.nan))
        placements = np.concatenate([placements, self._place_robot()])
        return np.array(time, "<f8").tobytes() + placements.tobytes() + points.tobytes() + lost.tobytes()

    def _place_robot(self) -> np.ndarray:
        """Rotation row by row and position [m] of each link of the robot in W, (links, 12)."""
        if self._driven is not None:
            robot, newest = self._driven.robot, self._driven.newest
            configuration = robot.configuration(robot.rest if newest is None else newest.u)
            pin.forwardKinematics(robot.model, self._robot_data, configuration)
        return _stack([self._root * self._robot_data.oMi[joint] for joint in self._robot_joints])


def _stack(placements: Sequence[Any]) -> np.ndarray:
    rows = np.empty((len(placements), 12), dtype="<f4")
    for k, placement in enumerate(placements):
        rows[k, :9] = placement.rotation.ravel()
        rows[k, 9:] = placement.translation
    return rows


class Guarded(RequestHandler):  # type: ignore[misc]
    """Answers only with the token, where there is one, else under this machine's own address."""

    def initialize(self, page: LivePage) -> None:
        self.page = page

    def prepare(self) -> None:
        token = self.page.token
        if token and not hmac.compare_digest(self.get_query_argument("token", "").encode(), token.encode()):
            raise HTTPError(403, reason="The address of this page has a token, as the terminal shows it.")
        if not token and self.request.host_name not in LOCAL_HOSTS:  # a foreign page's name may resolve to this machine
            raise HTTPError(403, reason="This page is known as 127.0.0.1 or localhost.")

    def set_default_headers(self) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value)

    def write_error(self, status_code: int, **_: Any) -> None:  # noqa: ARG002
        self.finish(self._reason)


class Page(Guarded):
    def get(self) -> None:
        self.finish(self.page.html)


class Stream(Guarded, WebSocketHandler):  # type: ignore[misc]
    """The connection to one browser; tornado refuses that of a foreign page."""

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
            with suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):  # it is no request
                fields = json.loads(message)
                request = Request(str(fields["action"]), str(fields.get("text", "")))
                # Who watches does not end the session.
                if request.action != QUIT.action and request.text.isprintable() and len(request.text) <= LONGEST_TEXT:
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


def _fill_page(model: BodyModel, encoder: PoseEncoder, title: str) -> str:
    """The page; its scene is the body in the N-pose, its camera sees all that the limbs can reach."""
    links, body = encoder.links, encoder.body_links
    motion = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(body), 1, 1)).astype("<f4")
    motion[:, 0, 4:] = encoder.neutral[:, 9:]
    content = {
        "id": encoder.identity,
        "links": list(links),
        "scene": scene(encoder.visuals, links, encoder.meshes),
        "floor": find_floor(model),
        "view": view(encoder.visuals, body, motion, encoder.reach),
        "trails": [{"name": hand, "colour": choose_trail_colour(hand, model)} for hand in model.table.draw.paths],
    }
    return fill_page("live/templates/live.html.j2", content, title or "wepose live")
