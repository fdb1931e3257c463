"""`SampleLosses`: how many samples of each sensor never came, by the times of those that did."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from ..recording.arrivals import Samples

FIRST_SAMPLES = 50  # by which a sensor's step is measured
FOLLOW = 0.1  # share of a sample's offset from the even times that these follow: clocks drift
RECENT = 4  # samples after a loss in which one that is late or out of order may turn out to be the lost one
SILENCE_S = 0.5  # [s] without a sample from which on the samples due since count as lost
UNEVEN = 0.2  # rms of what is left of the steps between two times; with more they are too uneven to count
JUMP_S = 60.0  # [s] between two samples from which on the clock was set and nothing is known


class SampleLosses:
    """Counts samples that never came; a sensor sends at even times, which jitter and drift."""

    def __init__(self) -> None:
        self._sensors: dict[str, _EvenTimes] = {}

    def push(self, samples: Iterable[Samples]) -> None:
        """Take samples in their order of arrival."""
        for chunk in samples:
            times = self._sensors.get(chunk.sensor)
            if times is None:
                times = self._sensors[chunk.sensor] = _EvenTimes()
            times.push(chunk.time)

    def count(self, sensor: str, now: float) -> int:
        """Count the samples of a sensor that have not come by `now` [s]; 0 before its step is known."""
        times = self._sensors.get(sensor)
        return 0 if times is None else times.count(now)


class _EvenTimes:
    """The times at which one sensor's samples are due."""

    def __init__(self) -> None:
        self._first: list[float] = []  # times [s], until the step is known
        self._step = math.nan  # [s]
        self._due = 0.0  # [s] of the newest sample, on the even times
        self._lost, self._since_loss = 0, RECENT + 1

    def push(self, time_s: np.ndarray) -> None:
        if math.isnan(self._step):
            self._first += time_s.tolist()
            if len(self._first) >= FIRST_SAMPLES:
                self._begin()
            return
        for t in time_s.tolist():
            self._take(t)

    def _begin(self) -> None:
        """Measure the step, and count what was lost so far."""
        first, self._first = self._first, []
        step = measure_step(np.array(first))
        if step > 0.0:
            self._step, self._due = step, first[0]
            for t in first[1:]:
                self._take(t)

    def _take(self, t: float) -> None:
        offset = t - self._due
        if not abs(offset) < JUMP_S:
            self._due, self._since_loss = t, RECENT + 1
            return
        steps = round(offset / self._step)
        self._since_loss += 1
        if steps > 1:
            self._lost += steps - 1
            self._since_loss = 0
        elif steps < 1:
            if self._lost and self._since_loss <= RECENT:
                self._lost -= 1
            return
        self._due += steps * self._step
        self._due += FOLLOW * (t - self._due)

    def count(self, now: float) -> int:
        """Count the samples that have not come by `now` [s]."""
        if math.isnan(self._step):
            return 0
        silent_s = now - self._due
        pending = int(silent_s / self._step) if SILENCE_S < silent_s < JUMP_S else 0
        return self._lost + pending


def measure_step(time_s: np.ndarray) -> float:
    """Measure the step [s] between times (n,) of which some are missing; 0: none can be measured."""
    time_s = np.unique(time_s)
    if len(time_s) < 3:
        return 0.0
    steps, span = np.diff(time_s), float(time_s[-1] - time_s[0])
    median, mean = float(np.median(steps)), span / len(steps)
    if mean > 3.0 * median:  # time stamps in bursts
        return mean
    count = np.rint(steps / median)
    if np.sqrt(np.mean((steps / median - count) ** 2)) < UNEVEN:
        return span / float(np.sum(count))
    return mean if abs(mean / median - 1.0) < 0.05 else median
