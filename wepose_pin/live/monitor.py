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
FIRST_SAMPLES = 50  # by which a sensor's step is measured
JUMP_S = 60.0  # [s] between two samples from which on the clock was set and nothing is known


class SensorMonitor:
    """Watches what comes from each sensor."""

    def __init__(self) -> None:
        self._counters: dict[str, SampleCounter] = {}  # of the sensors that have sent something
        self._recent: dict[str, deque[Samples]] = {}
        self._history: deque[tuple[float, dict[str, int]]] = deque()  # time [s], and samples by then
        self._wrong_unit, self._checked = "", -math.inf  # and the time [s] of the newest sample then

    def push(self, samples: Iterable[Samples], unchecked: Collection[str] = ()) -> None:
        """Take samples in their order of arrival; the unit of those of the `unchecked` sensors is not watched."""
        for chunk in samples:
            name = chunk.sensor
            if not len(chunk.time):
                continue
            if name not in self._counters:
                self._counters[name] = SampleCounter()
            self._counters[name].push(chunk.time)
            if name not in unchecked:
                recent = self._recent.setdefault(name, deque())
                recent.append(chunk)
                while recent[0].time[-1] < recent[-1].time[-1] - UNIT_WINDOW_S:
                    recent.popleft()

    @property
    def sending(self) -> list[str]:
        return list(self._counters)

    def list_silent(self, sensors: Iterable[str], now: float, silence_s: float) -> list[str]:
        """The sensors without a sample for longer than `silence_s` [s]."""
        counters = self._counters
        return [name for name in sensors if name not in counters or now - counters[name].newest > silence_s]

    def list_statuses(self, now: float, batteries: Mapping[str, float]) -> dict[str, SensorStatus]:
        """Rate over the last second, missing samples and battery of each sensor; called a few times a second."""
        self._history.append((now, {name: counter.total for name, counter in self._counters.items()}))
        while self._history[0][0] < now - RATE_WINDOW_S and len(self._history) > 2:
            self._history.popleft()
        begin, before = self._history[0]
        statuses = {}
        for name, counter in self._counters.items():
            rate_hz = (counter.total - before.get(name, 0)) / (now - begin) if now > begin else 0.0
            battery = batteries.get(name, math.nan)
            statuses[name] = SensorStatus(name, rate_hz, missing=counter.missing, battery=battery)
        return statuses

    def count_missing(self, sensor: str) -> int:
        """Count the samples of a sensor that never came."""
        return self._counters[sensor].missing if sensor in self._counters else 0

    def describe_wrong_unit(self, source: Source) -> str:
        """Describe the sensors whose rates contradict gravity, and what to do; empty: there is none."""
        newest = max((counter.newest for counter in self._counters.values()), default=-math.inf)
        if abs(newest - self._checked) < UNIT_PERIOD_S:
            return self._wrong_unit
        self._wrong_unit, self._checked, rates = "", newest, {}
        for sensor, recent in self._recent.items():
            time_s, gyro_S, accel_S = (np.concatenate(column) for column in tuple(zip(*recent, strict=True))[1:])
            step_s = measure_step(time_s)
            if step_s and time_s[-1] - time_s[0] > 0.9 * UNIT_WINDOW_S:
                rate = find_unseen_rate(gyro_S, accel_S, 1.0 / step_s)
                if math.isfinite(rate):
                    rates[sensor] = rate
        if rates:
            rate, remedy = max(rates.values()), source.explain_unit("gyro_unit", "deg/s")
            what = f"rates of {rate:.2g} rad/s while gravity does not turn: deg/s? {remedy}."
            self._wrong_unit = f"{join_names(list(rates))}: {what}"
        return self._wrong_unit


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


class SampleCounter:
    """Counts the samples of one sensor, and by the steps between their times those that never came."""

    def __init__(self) -> None:
        self.total, self.missing, self.newest = 0, 0, -math.inf  # that came, and did not; time [s] of the newest
        self._first: list[float] = []  # times [s], until the step is known
        self._step = 0.0  # [s]

    def push(self, time_s: np.ndarray) -> None:
        """Take the times (m,) [s] of samples in their order of arrival."""
        self.total += len(time_s)
        times = [t for t in time_s.tolist() if math.isfinite(t)]
        if not self._step:
            self._first += times
            self.newest = max([self.newest, *times])
            if len(self._first) < FIRST_SAMPLES:
                return
            self._step = measure_step(np.array(self._first))
            times, self._first, self.newest = self._first, [], self._first[0]
        for t in times:
            step = t - self.newest
            if step > 0.0 or step < -JUMP_S:
                self.newest = t
            if 0.0 < step < JUMP_S and self._step:
                self.missing += max(0, round(step / self._step) - 1)
            elif -JUMP_S < step < 0.0 and self.missing:  # it was overtaken, and taken for a lost one
                self.missing -= 1


def measure_step(time_s: np.ndarray) -> float:
    """Measure the step [s] between times (n,) of which some are missing; 0: none can be measured."""
    steps = np.diff(np.unique(time_s))
    if len(steps) < 2:
        return 0.0
    median, mean = float(np.median(steps)), float(steps.mean())
    count = np.rint(steps / median)
    is_even = mean < 3.0 * median and np.sqrt(np.mean((steps / median - count) ** 2)) < 0.2
    return float(steps.sum() / count.sum()) if is_even else mean  # else time stamps come in bursts, or jitter
