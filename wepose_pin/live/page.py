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

import secrets
from collections import deque

import numpy as np

from ..body import BodyModel
from ..body.links import find_known_points
from ..report.viewer import DARK, LIGHT, backdrop, choose_trail_colour, filled, find_floor, scene, view
from .addresses import LOOPBACK
from .encoder import PoseEncoder, RobotFigure, place_n_pose
from .server import Content, Server
from .state import LivePose, Output, Request, Status, StreamInfo

FINGERS = 0.1  # [m] beyond the end of a limb
MAX_REQUESTS = 16  # not yet taken; more are dropped


class LivePage(Output):
    """Serves the page from `open` to `close`.

    Parameters
    ----------
    model : the body, with its lengths
    host : address to listen on; another than loopback lets others in the network watch and press keys, who know the
        token in `url`
    port : 0 for any free one
    title : shown above the body
    """

    def __init__(self, model: BodyModel, host: str = LOOPBACK, port: int = 0, title: str = "") -> None:
        self._host, self._port, self._title = host, port, title
        self.url = ""  # of an open page
        self._server: Server | None = None
        self._requests: deque[Request] = deque(maxlen=MAX_REQUESTS)
        self.set_body(model)

    def open(self) -> None:
        """Serve the page from a thread of its own; raises `BadOption` where the address or port cannot be used."""
        if self._server is None:
            token = "" if self._host in (LOOPBACK, "localhost", "::1") else secrets.token_urlsafe(16)
            self._server = Server(self._content, self._host, self._port, token, self._requests)
            self.url = self._server.url

    def set_body(self, model: BodyModel, robot: RobotFigure | None = None) -> None:
        """Draw this body from now on, and a robot beside it; open browsers load the page again."""
        self._encoder, identity = PoseEncoder(model, robot), secrets.token_hex(8)
        self._content = Content(_fill_page(model, self._encoder, self._title, identity), identity, self._encoder)
        if self._server is not None:
            self._server.content = self._content

    def demonstrate(self, pose: LivePose, info: StreamInfo) -> None:
        if self._encoder.info is not info:
            self.start(info)
        self._encoder.newest = pose

    def start(self, info: StreamInfo) -> None:
        self._encoder.start(info)

    def show(self, pose: LivePose) -> None:
        """Take the newest pose; it is drawn when a browser is ready for it. Costs less than a microsecond."""
        self._encoder.newest = pose
        self._encoder.angles.push(pose)

    def status(self, status: Status) -> None:
        if self._server is not None:
            self._server.status = status

    def take_requests(self) -> list[Request]:
        return [self._requests.popleft() for _ in range(len(self._requests))]

    def close(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None


def _fill_page(model: BodyModel, encoder: PoseEncoder, title: str, identity: str) -> str:
    """The page; its scene is the body in the N-pose, its camera sees all that the limbs can reach."""
    links, body, robot = encoder.links, encoder.body_links, encoder.robot
    neutral = np.frombuffer(encoder.encode(None), "<f4", 12 * len(body), offset=8).reshape(-1, 12)
    motion = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(body), 1, 1)).astype("<f4")
    motion[:, 0, 4:] = neutral[:, 9:]
    floor, reach = find_floor(model), [_find_reach(model)]
    if robot is not None:
        reach.append(robot.points())
    data = {
        "id": identity,
        "links": list(links),
        "scene": scene(encoder.visuals, links, () if robot is None else robot.meshes),
        "backdrops": {name: backdrop(colours, floor) for name, colours in (("light", LIGHT), ("dark", DARK))},
        "view": view(encoder.visuals, body, motion, reach),
        "trails": [{"name": hand, "colour": choose_trail_colour(hand, model)} for hand in model.table.draw.paths],
    }
    return filled("live/templates/live.html.j2", data, title or "wepose live")


def _find_reach(model: BodyModel) -> np.ndarray:
    """Points (n, 3) [m] that the ends of limbs reach in front, at their side and up."""
    data = place_n_pose(model)
    known = find_known_points(model, model.chains)
    p_W = {point: data.oMf[model.pin.getFrameId(model.point_frames[point])].translation for point in known}
    points = [np.zeros(3)]
    for first, *_, last in model.table.draw.limbs:
        if last in model.table.draw.paths and first in p_W and last in p_W:
            reach = np.linalg.norm(p_W[last] - p_W[first]) + FINGERS
            sides = {"left": (1.0,), "right": (-1.0,)}.get(model.table.side(last), (1.0, -1.0))
            ways = [[1.0, 0.0, 0.0], *([0.0, side, 0.0] for side in sides), *([0.0, 0.6 * side, 0.8] for side in sides)]
            points += list(p_W[first] + reach * np.array(ways))
    return np.array(points)
