"""The pose as frames of the Xsens MVN network streamer: the whole figure, legs standing. See docs/live-page.md."""

from __future__ import annotations

from .figure import complete_figure
from .mvn_frames import encode_frame
from .outputs import RATE_HZ, RateLimiter, UdpSender
from .state import LivePose, Output, StreamInfo

PORT = 9763


class MvnOutput(Output):
    """Sends each pose as a datagram of type 02.

    Parameters
    ----------
    to : ``PORT`` of this machine, or ``HOST:PORT``
    rate_hz : poses a second at most; None: every pose

    Raises
    ------
    BadOption
        No such host, port or rate.
    """

    def __init__(self, to: str, rate_hz: float | None = RATE_HZ) -> None:
        self._limiter, self._sender = RateLimiter(rate_hz), UdpSender(to, "--mvn", PORT)
        self._info: StreamInfo | None = None
        self._counter, self._begin = 0, 0.0

    def start(self, info: StreamInfo) -> None:
        self._info, self._counter = info, 0

    def show(self, pose: LivePose) -> None:
        if self._info is None or not self._limiter.accepts(pose.time):
            return
        if not self._counter:
            self._begin = pose.time
        self._sender.send(encode_frame(complete_figure(self._info, pose), self._counter, pose.time - self._begin))
        self._counter += 1

    def close(self) -> None:
        self._sender.close()
