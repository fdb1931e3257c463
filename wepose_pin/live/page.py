"""The live page: the body in the browser while it moves, served to this machine only.

meshcat's own server listens on every interface and keeps what a slow browser has not taken, so the page is fed another
way: it carries meshcat's viewer inside and gets frames through a WebSocket of ours. A browser that has not drawn the
last frame gets none; when it asks again it gets the newest. `docs/live-page.md` says what goes over the line.
"""

from __future__ import annotations

import secrets
from collections import deque

import numpy as np
import pinocchio as pin

from ..model import POINTS, BodyModel
from ..model.chains import chains
from ..pose import known_points
from ..report.viewer import DARK, LIGHT, backdrop, filled, scene, trail_colour, view
from .figure import HANDS, Figure
from .server import Server
from .state import LivePose, Stage, Status

LOOPBACK = "127.0.0.1"
FINGERS = 0.1  # [m] from the middle of the palm
MOST_KEYS = 16  # not yet taken; more are thrown away


class LivePage:
    """An `Output` that browsers look at; `open` begins to serve it, `close` ends that.

    Parameters
    ----------
    model : the body, with its lengths
    stage : where it is known before the loop's `start`: what no sensor measures is then left out from the beginning
    host : address to listen on; another than loopback lets others in the network look on and press keys
    port : 0 for any free one
    title : shown above the body
    """

    def __init__(
        self, model: BodyModel, stage: Stage | None = None, host: str = LOOPBACK, port: int = 0, title: str = ""
    ) -> None:
        self._figure = Figure(model)
        if stage is not None:
            self._figure.begin(stage)
        self._host, self._port = host, port
        self._id = secrets.token_hex(8)
        self._page = _html(model, self._figure, title, self._id)
        self._server: Server | None = None
        self._keys: deque[str] = deque(maxlen=MOST_KEYS)

    def open(self) -> None:
        """Serve the page from a thread of its own.

        Raises
        ------
        BadOption
            The address is not this machine's, or the port is taken.
        """
        if self._server is None:
            self._server = Server(self._page, self._id, self._figure, self._keys, self._host, self._port)
            self._server.start()

    @property
    def url(self) -> str:
        """Where the page is; of an open one."""
        assert self._server is not None
        return self._server.url

    def start(self, stage: Stage) -> None:
        """From now on only what is measured is drawn."""
        self._figure.begin(stage)

    def show(self, pose: LivePose) -> None:
        """The newest pose; it is drawn when a browser is ready for one. Costs less than a microsecond."""
        self._figure.newest = pose

    def status(self, status: Status) -> None:
        """The newest status."""
        if self._server is not None:
            self._server.status = status

    def take_keys(self) -> list[str]:
        """What was pressed in the page since the last call: "r" for headings anew."""
        return [self._keys.popleft() for _ in range(len(self._keys))]

    def close(self) -> None:
        """Tell the browsers, and listen no more. May be called twice."""
        if self._server is not None:
            self._server.close()
            self._server = None

    def __enter__(self) -> LivePage:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _html(model: BodyModel, figure: Figure, title: str, identity: str) -> str:
    """The page; its scene is the body in the N-pose, its camera sees all that the hands can reach."""
    neutral = np.frombuffer(figure.frame(None), "<f4", 12 * len(figure.links), offset=8).reshape(-1, 12)
    motion = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(figure.links), 1, 1)).astype("<f4")
    motion[:, 0, 4:] = neutral[:, 9:]
    data = {
        "id": identity,
        "links": list(figure.links),
        "scene": scene(figure.visuals, figure.links),
        "backdrops": {"light": backdrop(LIGHT), "dark": backdrop(DARK)},
        "view": view(figure.visuals, figure.links, motion, [_reach(model)]),
        "trails": [{"name": hand, "colour": trail_colour(hand, figure.visuals)} for hand in HANDS],
    }
    return filled("live/templates/live.html.j2", data, title or "wepose live")


def _reach(model: BodyModel) -> np.ndarray:
    """(n, 3) [m]: where the hands come to in front, at the sides and above the head."""
    data = pin.Data(model.pin)
    pin.framesForwardKinematics(model.pin, data, pin.neutral(model.pin))
    known = [point for point in known_points(chains(model.pin)) if model.pin.existFrame(POINTS[point])]
    p_W = {point: data.oMf[model.pin.getFrameId(POINTS[point])].translation for point in known}
    ends = [np.zeros(3)]
    for side, left in (("left", 1.0), ("right", -1.0)):
        if f"{side}_hand" in p_W:
            p_shoulder = p_W[f"{side}_shoulder"]
            ways = np.array([[1.0, 0.0, 0.0], [0.7, 0.7 * left, 0.0], [0.0, left, 0.0], [0.0, 0.6 * left, 0.8]])
            ends += list(p_shoulder + (np.linalg.norm(p_W[f"{side}_hand"] - p_shoulder) + FINGERS) * ways)
    return np.array(ends)
