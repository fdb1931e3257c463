"""`SensorMonitor`: rate, losses and unit of each sensor, by the samples that come."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from ..diagnostics import Diagnostic
from ..errors import BadData, WrongUnit
from ..recording import Recording
from ..recording.arrivals import Samples
from ..recording.plausibility import check_signals, find_unseen_rate
from .sources.base import Source
from .state import SensorStatus, join_names

RATE_WINDOW_S = 1.0  # [s] over which samples are counted
UNIT_WINDOW_S = 4.0  # [s] newest samples of which rates are compared with the direction of gravity
UNIT_PERIOD_S = 0.2  # [s] between two such comparisons
LEAST_SHARE = 0.9  # of that, from which on they are
FIRST_SAMPLES = 50  # by which a sensor's step is measured
FOLLOW = 0.1  # share of a sample's offset from the even times that these follow: clocks drift
RECENT = 4  # samples after a loss in which one that is late or out of order may turn out to be the lost one
SILENCE_S = 0.5  # [s] without a sample from which on the samples due since count as lost
UNEVEN = 0.2  # rms of what is left of the steps between two times; with more they are too uneven to count
JUMP_S = 60.0  # [s] between two samples from which on the clock was set and nothing is known


class SensorMonitor:
    """Watches what comes from each sensor."""

    def __init__(self) -> None:
        self._even: dict[str, EvenTimes] = {}  # of the sensors that have sent something
        self._recent: dict[str, deque[Samples]] = {}
        self._history: deque[tuple[float, dict[str, int]]] = deque()  # time [s], and samples by then
        self._wrong_unit, self._checked = "", -math.inf  # and the time [s] of the newest sample then

    def push(self, samples: Iterable[Samples], unchecked: Collection[str] = ()) -> None:
        """Take samples in their order of arrival; the unit of those of the `unchecked` sensors is not watched."""
        for chunk in samples:
            name = chunk.sensor
            if not len(chunk.time):
                continue
            even = self._even.get(name)
            if even is None:
                even = self._even[name] = EvenTimes()
            even.push(chunk.time)
            if name not in unchecked:
                recent = self._recent.setdefault(name, deque())
                recent.append(chunk)
                while recent[0].time[-1] < recent[-1].time[-1] - UNIT_WINDOW_S:
                    recent.popleft()

    @property
    def sending(self) -> list[str]:
        """Sensors that have sent something."""
        return list(self._even)

    def list_silent(self, sensors: Iterable[str], now: float, silence_s: float) -> list[str]:
        """The sensors without a sample for longer than `silence_s` [s]."""
        return [name for name in sensors if name not in self._even or now - self._even[name].newest > silence_s]

    def list_statuses(self, now: float, batteries: Mapping[str, float]) -> dict[str, SensorStatus]:
        """Rate over the last second, missing samples and battery of each sensor; called a few times a second."""
        totals = {name: even.total for name, even in self._even.items()}
        self._history.append((now, totals))
        while self._history[0][0] < now - RATE_WINDOW_S and len(self._history) > 2:
            self._history.popleft()
        begin, before = self._history[0]
        statuses = {}
        for name, count in totals.items():
            rate_hz = (count - before.get(name, 0)) / (now - begin) if now > begin else 0.0
            missing, battery = self.count_missing(name, now), batteries.get(name, math.nan)
            statuses[name] = SensorStatus(name, rate_hz, missing=missing, battery=battery)
        return statuses

    def count_missing(self, sensor: str, now: float) -> int:
        """Count the samples of a sensor that have not come by `now` [s]; 0 before its step is known."""
        return self._even[sensor].count(now) if sensor in self._even else 0

    def describe_wrong_unit(self, source: Source) -> str:
        """Describe the sensors whose rates contradict gravity, and what to do; empty: there is none."""
        newest = max((even.newest for even in self._even.values()), default=-math.inf)
        if not abs(newest - self._checked) < UNIT_PERIOD_S:
            self._wrong_unit, self._checked = self._find_wrong_unit(source), newest
        return self._wrong_unit

    def _find_wrong_unit(self, source: Source) -> str:
        rates = {}
        for sensor, recent in self._recent.items():
            time_s, gyro_S, accel_S = (np.concatenate(column) for column in tuple(zip(*recent, strict=True))[1:])
            step_s = measure_step(time_s)
            if step_s and time_s[-1] - time_s[0] > LEAST_SHARE * UNIT_WINDOW_S:
                rate = find_unseen_rate(gyro_S, accel_S, 1.0 / step_s)
                if math.isfinite(rate):
                    rates[sensor] = rate
        if not rates:
            return ""
        remedy = source.explain_unit("gyro_unit", "deg/s")
        rate = max(rates.values())
        return f"{join_names(list(rates))}: rates of {rate:.2g} rad/s while gravity does not turn: deg/s? {remedy}."


def check_units(recording: Recording, source: Source) -> tuple[Diagnostic, ...]:
    """Check the sensors' values as those of a file, and return the diagnostics.

    Raises
    ------
    BadData
        Values of another unit; the text says how the source states it.
    """
    try:
        return check_signals(recording)
    except WrongUnit as error:
        raise BadData(f"{error.finding}: {error.unit}? {source.explain_unit(error.key, error.unit)}.") from None


class EvenTimes:
    """The times at which one sensor's samples are due, which jitter and drift: those that never came are counted.

    Attributes
    ----------
    total : number of samples so far
    newest : time [s] of the newest one; −inf before the first
    """

    def __init__(self) -> None:
        self.total, self.newest = 0, -math.inf
        self._first: list[float] = []  # times [s], until the step is known
        self._step = math.nan  # [s]
        self._due = 0.0  # [s] of the newest sample, on the even times
        self._lost, self._since_loss = 0, RECENT + 1

    def push(self, time_s: np.ndarray) -> None:
        """Take the times (m,) [s] of samples in their order of arrival."""
        times = time_s.tolist()
        self.total += len(times)
        if times[-1] > self.newest:
            self.newest = times[-1]
        if math.isnan(self._step):
            self._first += times
            if len(self._first) < FIRST_SAMPLES:
                return
            times, self._first = self._first, []
            step = measure_step(np.array(times))
            if not step > 0.0:
                return
            self._step, self._due = step, times[0]
        for t in times:
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
