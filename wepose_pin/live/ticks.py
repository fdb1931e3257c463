"""Samples as they come: rate and unit of each sensor; ticks of one clock; the start pose in the ticks."""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..body import BodyTable
from ..body.table import NEUTRAL_POSE
from ..diagnostics import Diagnostic
from ..errors import BadData, WrongUnit
from ..readers.live_log import Markers, build_recording
from ..recording import Intervals, Recording
from ..recording.arrivals import Arrivals, Samples, StreamSynchronizer, Ticks, order_arrivals
from ..recording.plausibility import find_unseen_rate
from ..tracking.start_pose import START_POSE_HOLD_S, StartPoseDetector
from .log import LiveLog
from .setup import SensorSetup
from .sources import MAX_VALUES, Source
from .state import join_names

WINDOW_S = 4.0  # [s] newest samples of which rates are compared with the direction of gravity
SILENT_STEP_S = 0.25  # [s] a longer step is a silence
RATE_MEASUREMENT_S = 1.0  # [s] over which the rate of the ticks is measured if the source does not know it
DEFAULT_RATE_HZ = 100.0  # where none can be measured
MAX_TICK_BLOCKS = 64  # blocks of ticks kept before those older than the start pose are dropped
STATE_UNIT = "State the unit, as in --source udp:9000,{}={}, or in the description of the LSL stream."
BEGUN_S = 0.5  # [s] of standing still after which a person who moves is told so


def measure_step(time_s: np.ndarray) -> float:
    """Measure the step [s] between times (n,) of which some are missing; 0: none can be measured."""
    steps = np.diff(np.unique(time_s))
    steps = steps[steps < SILENT_STEP_S]
    if len(steps) < 2:
        return 0.0
    median, mean = float(np.median(steps)), float(steps.mean())
    count = np.rint(steps / median)
    step = float(steps.sum() / count.sum())
    is_even = mean < 3.0 * median and np.sqrt(np.mean((steps / step - count) ** 2)) < 0.25
    return step if is_even else mean  # else time stamps come in bursts, or jitter


class SensorMonitor:
    """Rate and unit of each sensor that has sent something."""

    def __init__(self, source: Source) -> None:
        self.wrong_unit = ""  # a sentence on sensors whose rates contradict gravity; empty: there is none
        self.sending: dict[str, float] = {}  # sensor that has sent something → time [s] of its newest sample
        self.keeps_samples = True  # of the last `WINDOW_S`, for `collect` and to find a wrong unit
        self._source = source
        self._arrived: dict[str, float] = {}  # sensor → time [s] of the last arrival
        self._times: dict[str, deque[float]] = {}  # [s] of the samples of the last second
        self._recent: dict[str, list[Samples]] = {}

    def push(self, samples: Iterable[Samples]) -> None:
        """Take samples in their order of arrival."""
        now = self._source.clock()
        for chunk in samples:
            if not (len(chunk.time) and math.isfinite(newest := float(chunk.time[-1]))):
                continue
            self._arrived[chunk.sensor], self.sending[chunk.sensor] = now, newest
            times = self._times.setdefault(chunk.sensor, deque())
            if times and abs(float(chunk.time[0]) - times[-1]) > 1.0:  # a silence, or a clock that was set
                times.clear()
            times.extend(chunk.time.tolist())
            while not times[0] >= newest - 1.0:  # NaN too
                times.popleft()
            if self.keeps_samples:
                self._recent.setdefault(chunk.sensor, []).append(chunk)

    def list_silent(self, sensors: Iterable[str], now: float, silence_s: float) -> list[str]:
        """The sensors without a sample for longer than `silence_s` [s]."""
        return [name for name in sensors if now - self.sending.get(name, -math.inf) > silence_s]

    def collect(self, sensor: str, seconds: float) -> Samples:
        """The plausible samples of the newest `seconds` [s]."""
        time_s, gyro_S, accel_S = map(np.concatenate, tuple(zip(*self._recent[sensor], strict=True))[1:])
        rows = (time_s > self.sending[sensor] - seconds) & (time_s <= self.sending[sensor])
        rows &= (np.abs(np.hstack([gyro_S, accel_S])) <= MAX_VALUES).all(axis=1)
        return Samples(sensor, time_s[rows], gyro_S[rows], accel_S[rows])

    def update(self, now: float) -> dict[str, float]:
        """Sensor → samples a second over the last second, on the source's clock; looks for a wrong unit as well."""
        self.wrong_unit = self._find_wrong_unit() if self.keeps_samples else ""
        rates = {}
        for name, times in self._times.items():
            span_s = times[-1] - times[0]
            rates[name] = (len(times) - 1) / span_s if now - self._arrived[name] < 1.0 and span_s > 0.0 else 0.0
        return rates

    def _find_wrong_unit(self) -> str:
        rates = {}
        for name, recent in self._recent.items():
            recent[:] = [self.collect(name, WINDOW_S)]
            ((_, time_s, gyro_S, accel_S),) = recent
            if len(time_s) and np.ptp(time_s) > 0.9 * WINDOW_S and name not in self._source.orientations:
                rates[name] = find_unseen_rate(gyro_S, accel_S, (len(time_s) - 1) / float(np.ptp(time_s)))
        rates = {name: rate for name, rate in rates.items() if math.isfinite(rate)}
        if not rates:
            return ""
        what = f"rates of {max(rates.values()):.2g} rad/s while gravity does not turn: deg/s?"
        return f"{join_names(list(rates))}: {what} {STATE_UNIT.format('gyro_unit', 'deg/s')}"


def check_units(recording: Recording) -> tuple[Diagnostic, ...]:
    """Check the sensors' values as those of a file; raises `BadData`, which says how a source states another unit."""
    try:
        return recording.check_signals()
    except WrongUnit as error:
        raise BadData(f"{error.finding}: {error.unit}? {STATE_UNIT.format(error.key, error.unit)}") from None


class Recorder:
    """Records samples in a file, and makes ticks of them once every sensor has sent one and the rate is known.

    `clock` makes the ticks; before they have begun it has seen nothing. `ticks` holds them until somebody clears it.
    The file, which `path`, `header` and `force` decide as of `LiveLog`, gives the same ticks and phases again.
    """

    def __init__(
        self, source: Source, header: Mapping[str, Any], path: Path | None = None, force: bool = False
    ) -> None:
        self.sensors, self.orientations, self.header = tuple(source.sensors), source.orientations, header
        self.log, self._markers = LiveLog(path, header, force), Markers()
        self.clock = StreamSynchronizer(self.sensors, DEFAULT_RATE_HZ, 0.0, self.orientations)
        self.has_begun, self.ticks = False, list[Ticks]()
        self._rate_hz, self._begin = source.rate_hz, source.begin
        self._waiting: list[Arrivals] = []

    @property
    def newest(self) -> float:
        """Time [s] of the newest tick."""
        return self.clock.begin + (self.clock.next_tick - 1) / self.clock.rate_hz

    def detect_start_pose(self, hold_s: float = START_POSE_HOLD_S) -> StartPoseDetector:
        measured = np.array([name in self.orientations for name in self.sensors], dtype=np.bool_)
        return StartPoseDetector(self.clock.rate_hz, measured, hold_s)

    def push(self, samples: Sequence[Samples]) -> Iterator[Ticks]:
        """Record the samples of one read, and iterate over the ticks that they complete."""
        self.log.flush_if_due()
        if not samples:
            return
        arrivals = order_arrivals(samples, self.sensors)
        self.log.samples(arrivals)
        self._waiting.append(arrivals)
        if not self.has_begun:
            self._begin_ticks()
        if self.has_begun:
            waiting, self._waiting = self._waiting, []
            for each in waiting:
                for ticks in self.clock.push(each):
                    self.ticks.append(ticks)
                    yield ticks
                self.log.flush_if_due()

    def _begin_ticks(self) -> None:
        which, rows = map(np.concatenate, zip(*self._waiting, strict=True))
        times = [rows[which == i, 0] for i in np.unique(which)]
        if len(times) < len(self.sensors):
            return
        first, newest = max(float(own[0]) for own in times), max(float(own[-1]) for own in times)
        rate, begin = self._rate_hz, first if self._begin is None else self._begin
        if rate is None:
            if newest - first < RATE_MEASUREMENT_S:
                return
            rates = [1.0 / step for step in map(measure_step, times) if step]
            rate = max(1.0, round(min(rates), 1)) if rates else DEFAULT_RATE_HZ  # that of the slowest sensor
        self.clock = StreamSynchronizer(self.sensors, rate, begin, self.orientations)
        self.has_begun = True
        self.log.event("clock", rate_hz=rate, begin=begin)

    def mark(self, kind: str, **values: Any) -> None:
        """Record an event: the begin or end of a phase, or what is discarded of it."""
        self._markers.add(kind, values)
        self.log.event(kind, **values)

    def list_phases(self) -> dict[str, Intervals]:
        return self._markers.phases(self.clock.begin, self.newest) if self.ticks else {}

    def make_recording(self, start: tuple[int, int] | None = None, last: int | None = None) -> Recording:
        """Make the recording of the ticks, up to the tick `last`, with the start pose's first and last tick `start`."""
        header = {**self.header, "phases": {**self.header["phases"], **self.list_phases()}}
        return build_recording(header, self.clock.rate_hz, self.ticks, start, self.log.path, last=last)


class StartPoseSearch:
    """Finds the start pose in the ticks before tracking: stated by the session, or held for `START_POSE_HOLD_S`."""

    def __init__(self, stream: Recorder, setup: SensorSetup, table: BodyTable) -> None:
        self._stream, self._pose = stream, stream.detect_start_pose()
        self._stated = next(iter(setup.phases.get("start", ())), None)
        self._longest_s = 0.0  # [s] for which the person stood still
        self._instruction = f"Hold still in the start pose, {setup.start_pose}"
        if table.is_mechanism:
            self._instruction = f"{table.name} must stand still in its start configuration"
        elif setup.start_pose == NEUTRAL_POSE:
            self._instruction = "Stand upright and still, arms hanging, palms to the thighs"

    def push(self, ticks: Ticks) -> tuple[int, int, int] | None:
        """Add the stream's newest ticks; return the start pose's first and last tick, and the row in `ticks` after it.

        None: it has not been held yet.
        """
        if self._stated is not None:
            rate_hz = self._stream.clock.rate_hz
            (row,) = np.nonzero(ticks.time >= self._stated[1] - 0.5 / rate_hz)
            if row.size:
                begin = round((self._stated[0] - self._stream.clock.begin) * rate_hz)
                return max(0, begin), ticks.first + int(row[0]), int(row[0]) + 1
            return None
        last = self._pose.push(ticks.gyro_S, ticks.accel_S)
        if last is not None:
            return self._pose.begin, self._pose.end, last + 1
        if len(self._stream.ticks) > MAX_TICK_BLOCKS:
            self._stream.ticks = [each for each in self._stream.ticks if each.first + len(each.time) > self._pose.begin]
        return None

    def describe(self, wrong_unit: str, frozen: str) -> tuple[str, str, float]:
        """Return state, message and progress, with sentences on sensors in another unit and on frozen ones, or none."""
        pose, sensors = self._pose, self._stream.sensors
        if self._stated is not None:
            begin, end = self._stated
            progress = float(np.clip((self._stream.newest - begin) / (end - begin), 0.0, 1.0))
            return "start_pose", f"{self._instruction}, until {end:g} s.", progress
        if pose.state == "waiting":
            return "waiting", frozen or f"Waiting for {join_names([sensors[k] for k in pose.missing])}.", 0.0
        progress = min(1.0, pose.held_s / START_POSE_HOLD_S)
        self._longest_s = max(self._longest_s, pose.held_s)
        if wrong_unit:
            return "moved", wrong_unit, progress
        if pose.state != "moved":
            left_s = max(0.0, START_POSE_HOLD_S - pose.held_s)
            return "start_pose", f"{self._instruction}: {left_s:.0f} s more.", progress
        if self._longest_s < BEGUN_S:  # the person walks to the place, or takes the pose
            return "start_pose", f"{self._instruction}.", 0.0
        moved, again = join_names([sensors[k] for k in pose.moving]), self._instruction
        return "moved", f"You moved ({moved}). Once more: {again[0].lower()}{again[1:]}.", progress
