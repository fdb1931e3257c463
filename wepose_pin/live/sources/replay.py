"""A recording, replayed as its sensors would deliver it."""

from __future__ import annotations

import math
import time

import numpy as np

from ...errors import BadOption
from ...recording import OrientationSensor, Recording
from ...recording.arrivals import Samples, list_numbers
from .base import Source
from .waiting import Waiting

BLOCK = 64  # samples of every sensor at once, as fast as possible
# Up to 1 kHz every sample comes when it is due, faster ones come together.
MIN_SLEEP_S = 0.0005


class ReplaySource(Source):
    """A recording at `speed` times its own pace.

    Samples in marked gaps are left out, as of a silent sensor. Samples that become due between two reads come together.

    Parameters
    ----------
    speed : 1.0 its own, ``math.inf`` as fast as possible

    Attributes
    ----------
    recording : that is replayed

    Raises
    ------
    BadOption
        A speed that is not positive.
    """

    def __init__(self, recording: Recording, speed: float = 1.0) -> None:
        if not speed > 0.0:
            raise BadOption(f"speed: {speed:g}; it must be positive: 1.0 is the recording's own, 4.0 four times that")
        super().__init__(recording.sensors, recording.rate_hz)
        self._orientations = {
            segment: sensor.aligned
            for segment, sensor in recording.sensors.items()
            if isinstance(sensor, OrientationSensor)
        }
        self._numbers = dict(zip(recording.sensors, map(list_numbers, recording.sensors.values()), strict=True))
        self.recording = recording
        # Samples are taken as evenly spaced: the jitter of the clock is no motion, and every sample has its own tick.
        self._time = recording.time[0] + np.arange(len(recording)) / recording.rate_hz
        self._speed = speed
        self._next = 0
        self._begin = 0.0

    @property
    def orientations(self) -> dict[str, bool]:
        return self._orientations

    def open(self, waiting: Waiting | None = None) -> None:  # noqa: ARG002
        """Start: the first sample is due now."""
        self._next = 0
        self._begin = time.monotonic()

    def clock(self) -> float:
        """Now [s] on the recording's time; as fast as possible, the time of the newest sample delivered."""
        if math.isinf(self._speed):
            return float(self._time[max(self._next - 1, 0)])
        return float(self._time[0]) + (time.monotonic() - self._begin) * self._speed

    def read(self, timeout_s: float) -> list[Samples] | None:
        """Samples that became due since the last call, one `Samples` a sensor; None after the last."""
        recording, time_s, first = self.recording, self._time, self._next
        if first >= len(recording):
            return None
        deadline = time.monotonic() + timeout_s
        while (last := self._count_due()) <= first:
            wait = (float(time_s[first]) - self.clock()) / self._speed
            left = deadline - time.monotonic()
            if left <= 0.0:
                return []
            time.sleep(min(max(wait, MIN_SLEEP_S), left))
        self._next = last
        samples = []
        for segment, sensor in recording.sensors.items():
            rows: slice | np.ndarray = slice(first, last)
            if sensor.gap is not None and sensor.gap[rows].any():
                rows = first + np.flatnonzero(~sensor.gap[first:last])
                if not rows.size:
                    continue
            gyro_S, accel_S = self._numbers[segment]
            samples.append(Samples(segment, time_s[rows], gyro_S[rows], accel_S[rows]))
        return samples

    def close(self) -> None:
        """Nothing to free."""

    def _count_due(self) -> int:
        """One past the last sample that is due."""
        if math.isinf(self._speed):
            return min(self._next + BLOCK, len(self.recording))
        return int(np.searchsorted(self._time, self.clock(), side="right"))
