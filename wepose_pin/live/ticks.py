"""Arrivals of a source → ticks of one clock, from when the sensors and the rate are known; the start pose in them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from ..body import BodyTable
from ..body.table import NEUTRAL_POSE
from ..errors import BadData
from ..recording.arrivals import Arrivals, Samples, StreamSynchronizer, Ticks, order_arrivals
from ..tracking.start_pose import START_POSE_HOLD_S, StartPoseDetector
from ..writers.live_log import LiveLog
from .monitor import measure_step
from .setup import SensorSetup
from .state import join_names

RATE_MEASUREMENT_S = 1.0  # [s] over which the rate is measured if the source does not know it
DEFAULT_RATE_HZ = 100.0  # where none can be measured
MAX_TICK_BLOCKS = 64  # blocks of ticks kept before those older than the start pose are dropped
BEGUN_S = 0.5  # [s] of standing still after which a person who moves is told so


class TickStream:
    """Makes ticks once every sensor has sent a sample and the rate is known, and records the arrivals.

    Parameters
    ----------
    rate_hz : of the ticks; None: that of the slowest sensor is measured
    begin : time [s] of the first tick; None: when every sensor has sent a sample
    log : the recording; None: nothing is recorded
    orientations : sensors whose samples are measured orientations
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
        self.synchronizer: StreamSynchronizer | None = None  # makes the ticks, from when they begin
        self._orientations, self._rate_hz, self._begin = orientations, rate_hz, begin
        self._waiting: list[Arrivals] = []

    @property
    def clock(self) -> StreamSynchronizer:
        """What makes the ticks; raises `BadData` before they begin."""
        if self.synchronizer is None:
            raise BadData("there are no samples of all sensors yet")
        return self.synchronizer

    @property
    def newest(self) -> float:
        return self.clock.begin + (self.clock.next_tick - 1) / self.clock.rate_hz

    def push(self, samples: Sequence[Samples]) -> Iterator[Ticks]:
        """Record the samples of one read, and iterate over the ticks that they complete."""
        samples = [chunk for chunk in samples if len(chunk.time)]
        if not samples:
            return
        arrivals = order_arrivals(samples, self.sensors)
        if self.log is not None:
            self.log.samples(arrivals)
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
        if len(times) < len(self.sensors):
            return
        first, newest = max(float(own[0]) for own in times), max(float(own[-1]) for own in times)
        rate, begin = self._rate_hz, first if self._begin is None else self._begin
        if rate is None:
            if newest - first < RATE_MEASUREMENT_S:
                return
            # That of the slowest sensor.
            rates = [1.0 / step for step in map(measure_step, times) if step]
            rate = max(1.0, round(min(rates), 1)) if rates else DEFAULT_RATE_HZ
        self.synchronizer = clock = StreamSynchronizer(self.sensors, rate, begin, orientations=self._orientations)
        if self.log is not None:
            self.log.event("clock", rate_hz=clock.rate_hz, begin=clock.begin, wait_s=clock.wait_s)


class StillPose(StartPoseDetector):
    """Detects in the ticks of a stream that no sensor has moved for `hold_s` [s]."""

    def __init__(self, stream: TickStream, hold_s: float = START_POSE_HOLD_S) -> None:
        super().__init__(stream.clock.rate_hz, stream.measured, hold_s)

    def push_ticks(self, ticks: Ticks) -> int | None:
        """Add ticks; return the row of the one at which the pose has been held so long; None: not yet."""
        for row, (gyro_S, accel_S) in enumerate(zip(ticks.gyro_S, ticks.accel_S, strict=True)):
            if self.push(gyro_S, accel_S) == "ready":
                return row
        return None


class StartPoseSearch:
    """Finds the start pose in the ticks before tracking: stated by the session, or held for `START_POSE_HOLD_S`."""

    def __init__(self, stream: TickStream, setup: SensorSetup, table: BodyTable) -> None:
        self._stream, self._pose = stream, StillPose(stream)
        self._stated = next(iter(setup.phases.get("start", ())), None)
        self._instruction = f"Hold still in the start pose, {setup.start_pose}"
        if table.is_mechanism:
            self._instruction = f"{table.name} must stand still in its start configuration"
        elif setup.start_pose == NEUTRAL_POSE:
            self._instruction = "Stand upright and still, arms hanging, palms to the thighs"
        self._longest_s = 0.0  # [s] for which the person stood still
        self.ticks: list[Ticks] = []  # since before the start pose

    def push(self, ticks: Ticks) -> tuple[int, int, int] | None:
        """Add ticks; return the start pose's first and last tick and the row in `ticks` after it; None: not yet."""
        self.ticks.append(ticks)
        clock = self._stream.clock
        if self._stated is not None:
            (row,) = np.nonzero(ticks.time >= self._stated[1] - 0.5 / clock.rate_hz)
            if row.size:
                begin = max(0, round((self._stated[0] - clock.begin) * clock.rate_hz))
                return begin, ticks.first + int(row[0]), int(row[0]) + 1
            return None
        last = self._pose.push_ticks(ticks)
        if last is not None:
            return self._pose.begin, self._pose.end, last + 1
        if len(self.ticks) > MAX_TICK_BLOCKS:
            self.ticks = [each for each in self.ticks if each.first + len(each.time) > self._pose.begin]
        return None

    def describe(self, wrong_unit: str, frozen: str) -> tuple[str, str, float]:
        """Return the state, the message to the person, and the progress, 0 to 1.

        `wrong_unit` and `frozen` are sentences on sensors in another unit, and on frozen ones, or empty.
        """
        pose, sensors = self._pose, self._stream.sensors
        if self._stated is not None:
            begin, end = self._stated
            progress = float(np.clip((self._stream.clock.newest - begin) / (end - begin), 0.0, 1.0))
            return "start_pose", f"{self._instruction}, until {end:g} s.", progress
        if pose.state == "waiting":
            return "waiting", frozen or f"Waiting for {join_names([sensors[k] for k in pose.missing])}.", 0.0
        progress = min(1.0, pose.held_s / START_POSE_HOLD_S)
        if wrong_unit:
            return "moved", wrong_unit, progress
        self._longest_s = max(self._longest_s, pose.held_s)
        if pose.state != "moved":
            left_s = max(0.0, START_POSE_HOLD_S - pose.held_s)
            return "start_pose", f"{self._instruction}: {left_s:.0f} s more.", progress
        if self._longest_s < BEGUN_S:  # the person walks to the place, or takes the pose
            return "start_pose", f"{self._instruction}.", 0.0
        moved, again = join_names([sensors[k] for k in pose.moving]), self._instruction
        return "moved", f"You moved ({moved}). Once more: {again[0].lower()}{again[1:]}.", progress
