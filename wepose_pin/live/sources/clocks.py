"""A sender's clock on ours: the sample that came fastest tells how far the two are apart.

A sample's arrival minus its time is the clocks' offset plus the sample's delay, and a delay is never negative: the
smallest of the last ten seconds is the best guess of the offset (the minimum filter of NTP, RFC 5905, section 10, kept
over a window so that drift is followed). What is applied follows that guess smoothly, so that even steps of a sensor
stay even.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

BUCKET_S = 1.0
WINDOW_S = 10.0
# The applied offset nears the guess with this time constant, and never faster than this share of time.
SETTLE_S = 2.0
MOST_SLEW = 0.01
# A sample this much faster than any before it: the sender's clock was set, or the first samples came late.
JUMP_S = 0.05
# Time that goes back by this much: the sender started anew. Less is a datagram that was overtaken.
BACK_S = 1.0


class HostClock:
    """The clock of one sender, learnt from what arrives."""

    def __init__(self) -> None:
        self._buckets: deque[tuple[float, float]] = deque()  # (begin [s] of arrival, smallest arrival − time [s])
        self._newest = -math.inf
        self._offset = 0.0

    def to_host(self, time: np.ndarray, arrival: float) -> np.ndarray:
        """Times (m,) [s] on our clock of samples that came together, at `arrival` [s] on it."""
        newest = float(time.max())
        seen = arrival - newest
        if newest < self._newest - BACK_S or seen < self._offset - JUMP_S or not math.isfinite(self._newest):
            self._buckets.clear()
            self._newest, self._offset = newest, seen
        guess = self._smallest(seen, arrival)
        passed = newest - self._newest
        if passed <= 0.0:
            return time + self._offset
        change = (guess - self._offset) * -math.expm1(-passed / SETTLE_S)
        offset = self._offset + min(max(change, -MOST_SLEW * passed), MOST_SLEW * passed)
        host = time + (offset if len(time) == 1 else np.interp(time, [self._newest, newest], [self._offset, offset]))
        self._newest, self._offset = newest, offset
        return host

    def _smallest(self, seen: float, arrival: float) -> float:
        """The smallest of the window, this one included."""
        buckets = self._buckets
        if buckets and arrival - buckets[-1][0] < BUCKET_S:
            buckets[-1] = (buckets[-1][0], min(seen, buckets[-1][1]))
        else:
            buckets.append((arrival, seen))
        while arrival - buckets[0][0] > WINDOW_S:
            buckets.popleft()
        return min(smallest for _, smallest in buckets)
