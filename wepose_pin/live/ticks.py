"""Arrivals of a source → ticks of one clock, from when the sensors and the rate are known; a pose held in them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from ..errors import BadData
from ..recording.arrivals import JUMP_S, Arrivals, Samples, StreamSynchronizer, Ticks, order_arrivals
from ..tracking.start_pose import StartPoseDetector
from ..writers.live_log import LiveLog
from .monitor import measure_step

RATE_MEASUREMENT_S = 1.0  # [s] over which the rate is measured if the source does not know it
MAX_ABSENCE_S = 3.0  # [s] after which ticks begin without a sensor that has sent nothing
MAX_HISTORY = 2_000_000  # samples that wait for a recording that may begin: an hour of five sensors at 100 Hz, 110 MB
DEFAULT_RATE_HZ = 100.0  # where none can be measured


class TickStream:
    """Makes ticks once every sensor has sent a sample and the rate is known, and records the arrivals.

    Parameters
    ----------
    rate_hz : of the ticks; None: that of the slowest sensor is measured
    begin : time [s] of the first tick; None: when every sensor has sent a sample
    log : the recording; None: nothing is recorded
    orientations : sensors whose samples are measured orientations

    Attributes
    ----------
    measured : (k,) bool: the sensors of `orientations`
    history : the arrivals so far, while nothing is recorded; None once there are more than `MAX_HISTORY`
    synchronizer : what makes the ticks; None before they begin
    """

    def __init__(
        self,
        sensors: Sequence[str],
        rate_hz: float | None = None,
        begin: float | None = None,
        log: LiveLog | None = None,
        orientations: Collection[str] = (),
    ) -> None:
        self.sensors, self.log = tuple(sensors), log
        self.measured = np.array([name in orientations for name in self.sensors], dtype=np.bool_)
        self.synchronizer: StreamSynchronizer | None = None
        self.history: list[Arrivals] | None = [] if log is None else None
        self._orientations, self._rate_hz, self._begin = orientations, rate_hz, begin
        self._history_size = 0  # samples
        self._waiting: list[Arrivals] = []

    @property
    def clock(self) -> StreamSynchronizer:
        """What makes the ticks; raises `BadData` before they begin."""
        if self.synchronizer is None:
            raise BadData("there are no samples of all sensors yet")
        return self.synchronizer

    def push(self, samples: Sequence[Samples]) -> Iterator[Ticks]:
        """Record the samples of one read, and iterate over the ticks that they complete."""
        samples = [chunk for chunk in samples if len(chunk.time)]
        if not samples:
            return
        arrivals = order_arrivals(samples, self.sensors)
        if self.log is not None:
            self.log.samples(arrivals)
        elif self.history is not None:
            self.history.append(arrivals)
            self._history_size += len(arrivals.time)
            self.history = self.history if self._history_size <= MAX_HISTORY else None
        self._waiting.append(arrivals)
        if self.synchronizer is None:
            self._begin_ticks()
        if self.synchronizer is not None:
            waiting, self._waiting = self._waiting, []
            for each in waiting:
                for ticks in self.synchronizer.iterate_ticks(each):
                    yield ticks
                    if self.log is not None:
                        self.log.flush_if_due()

    def _begin_ticks(self) -> None:
        which, time_s = (np.concatenate(parts) for parts in tuple(zip(*self._waiting, strict=True))[:2])
        times = [time_s[which == i] for i in np.unique(which)]
        first, newest = np.array([float(own[0]) for own in times]), max(float(own[-1]) for own in times)
        if len(first) < len(self.sensors) and newest - first.min() < MAX_ABSENCE_S:
            return
        rate = self._rate_hz
        if rate is None:
            if newest - first.max() < RATE_MEASUREMENT_S:
                return
            # That of the slowest sensor.
            rates = [1.0 / step for step in map(measure_step, times) if step]
            rate = max(1.0, round(min(rates), 1)) if rates else DEFAULT_RATE_HZ
        # A time-stamp outlier must not put all other sensors before the beginning.
        begin = self._begin if self._begin is not None else float(first[first < np.median(first) + JUMP_S].max())
        self.synchronizer = StreamSynchronizer(self.sensors, rate, begin, orientations=self._orientations)
        self._record_clock()

    def record(self, log: LiveLog) -> None:
        """Record from now on, and what came before: the recording is as one from the beginning.

        Only where there is a `history`.
        """
        history, self.history, self.log = self.history, None, log
        for arrivals in history or ():
            log.samples(arrivals)
        self._record_clock()

    def _record_clock(self) -> None:
        if self.log is not None and self.synchronizer is not None:
            clock = self.synchronizer
            self.log.event("clock", rate_hz=clock.rate_hz, begin=clock.begin, wait_s=clock.wait_s)


class StillPose(StartPoseDetector):
    """Detects in the ticks of a stream that no sensor has moved for `hold_s` [s]."""

    def __init__(self, stream: TickStream, hold_s: float) -> None:
        super().__init__(stream.clock.rate_hz, stream.measured, hold_s)

    def push_ticks(self, ticks: Ticks) -> int | None:
        """Add ticks; return the row of the one at which the pose has been held so long; None: not yet."""
        for row, (gyro_S, accel_S) in enumerate(zip(ticks.gyro_S, ticks.accel_S, strict=True)):
            if self.push(gyro_S, accel_S) == "ready":
                return row
        return None
