"""A recording, delivered as its sensors would."""

from __future__ import annotations

import math
import time

import numpy as np

from ...errors import BadOption
from ...recording import Recording
from ...recording.arrivals import Samples

# As fast as possible: so many samples of every sensor at once.
BLOCK = 64
# No shorter sleep [s]: up to 1 kHz every sample comes when it is due, faster ones come together.
SHORTEST_SLEEP_S = 0.0005


class ReplaySource:
    """A recording at `speed` times its own pace, or as fast as it is read.

    Samples in marked gaps are left out: the sensor was silent there. What fell due while nobody read comes at the next
    `read`, at once and whole.

    Parameters
    ----------
    speed : 1.0 its own, 4.0 faster, ``math.inf`` as fast as possible

    Attributes
    ----------
    recording : what is replayed

    Raises
    ------
    BadOption
        A sensor that gives measured orientations, or a speed that is not positive.
    """

    def __init__(self, recording: Recording, speed: float = 1.0) -> None:
        if not speed > 0.0:
            raise BadOption(f"speed: {speed:g}; it must be positive: 1.0 is the recording's own, 4.0 four times that")
        fused = [segment for segment in recording.sensors if segment not in recording.imus]
        if fused:
            raise BadOption(
                f"{recording.where()}: sensors.{fused[0]} gives measured orientations; live needs gyro and accel"
            )
        self.sensors = tuple(recording.sensors)
        self.rate_hz: float | None = recording.rate_hz
        self.problems: dict[str, int] = {}
        self.recording = recording
        # The recording counts as even: what its clock jittered is no motion, and every sample has its own tick.
        self._time = recording.time[0] + np.arange(len(recording)) / recording.rate_hz
        self._speed = speed
        self._next = 0
        self._begin = 0.0

    def open(self) -> None:
        """Start: the first sample is due now."""
        self._next = 0
        self._begin = time.monotonic()

    def clock(self) -> float:
        """Now [s] on the recording's time; as fast as possible, the time of the newest sample delivered."""
        if math.isinf(self._speed):
            return float(self._time[max(self._next - 1, 0)])
        return float(self._time[0]) + (time.monotonic() - self._begin) * self._speed

    def read(self, timeout_s: float) -> list[Samples] | None:
        """Everything that fell due since the last call, one `Samples` a sensor; None after the last sample."""
        recording, time_s, first = self.recording, self._time, self._next
        if first >= len(recording):
            return None
        deadline = time.monotonic() + timeout_s
        while (last := self._due()) <= first:
            wait = (float(time_s[first]) - self.clock()) / self._speed
            left = deadline - time.monotonic()
            if left <= 0.0:
                return []
            time.sleep(min(max(wait, SHORTEST_SLEEP_S), left))
        self._next = last
        samples = []
        for segment, sensor in recording.imus.items():
            kept: slice | np.ndarray = slice(first, last)
            if sensor.gap is not None and sensor.gap[kept].any():
                kept = first + np.flatnonzero(~sensor.gap[first:last])
                if not kept.size:
                    continue
            samples.append(Samples(segment, time_s[kept], sensor.gyro_S[kept], sensor.accel_S[kept]))
        return samples

    def close(self) -> None:
        """Nothing was taken."""

    def _due(self) -> int:
        """One past the last sample that is due."""
        if math.isinf(self._speed):
            return min(self._next + BLOCK, len(self.recording))
        return int(np.searchsorted(self._time, self.clock(), side="right"))
