"""The offset of a sender's clock from ours, from the samples with the smallest delay.

A sample's arrival minus its time is the clocks' offset plus the sample's delay, and a delay is never negative: the
smallest of the last ten seconds is the best estimate of the offset (the minimum filter of NTP, RFC 5905, section 10,
over a window that follows drift). The applied offset follows that estimate smoothly, so that regular samples stay
regular.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

BUCKET_S = 1.0
WINDOW_S = 10.0
# Time constant of the applied offset, and its largest rate.
SETTLE_S = 2.0
MAX_SLEW = 0.01
# [s] by which a sample is faster than all before: the sender's clock was set, or the first samples came late.
JUMP_S = 0.05
# [s] by which time goes back: the sender has restarted. Less: a datagram was overtaken.
BACK_S = 1.0


class HostClock:
    """Estimates the clock of one sender from its samples."""

    def __init__(self) -> None:
        self._buckets: deque[tuple[float, float]] = deque()  # (begin [s] of arrival, smallest arrival − time [s])
        self._newest = -math.inf
        self._offset = 0.0

    def to_host(self, time: np.ndarray, arrival: float) -> np.ndarray:
        """Times (m,) [s] on our clock of samples that came together, at `arrival` [s] on it."""
        newest = float(time.max())
        delay = arrival - newest  # with the offset
        if newest < self._newest - BACK_S or delay < self._offset - JUMP_S or not math.isfinite(self._newest):
            self._buckets.clear()
            self._newest, self._offset = newest, delay
        buckets = self._buckets
        if buckets and arrival - buckets[-1][0] < BUCKET_S:
            buckets[-1] = (buckets[-1][0], min(delay, buckets[-1][1]))
        else:
            buckets.append((arrival, delay))
        while arrival - buckets[0][0] > WINDOW_S:
            buckets.popleft()
        estimate = min(smallest for _, smallest in buckets)
        passed = newest - self._newest
        if passed <= 0.0:
            return time + self._offset
        change = (estimate - self._offset) * -math.expm1(-passed / SETTLE_S)
        offset = self._offset + min(max(change, -MAX_SLEW * passed), MAX_SLEW * passed)
        host = time + (offset if len(time) == 1 else np.interp(time, [self._newest, newest], [self._offset, offset]))
        self._newest, self._offset = newest, offset
        return host
