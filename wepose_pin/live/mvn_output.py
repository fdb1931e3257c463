"""The pose as frames of the Xsens MVN network streamer: the whole figure, legs standing. See docs/live-page.md."""

from __future__ import annotations

from .figure import complete_figure
from .mvn_frames import encode_frame
from .outputs import DatagramOutput
from .state import LivePose, StreamInfo

PORT = 9763
RATE_HZ = 60.0  # of a suit of 17 wireless sensors


class MvnOutput(DatagramOutput):
    """Sends each pose as a datagram of type 02."""

    option, port = "--mvn", PORT

    def __init__(self, to: str, rate_hz: float | None = RATE_HZ) -> None:
        super().__init__(to, rate_hz)

    def start(self, info: StreamInfo) -> None:
        super().start(info)
        self._counter, self._begin = 0, 0.0

    def encode(self, info: StreamInfo, pose: LivePose) -> list[bytes]:
        if not self._counter:
            self._begin = pose.time
        frame = encode_frame(complete_figure(info, pose), self._counter, pose.time - self._begin)
        self._counter += 1
        return [frame]
