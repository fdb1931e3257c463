"""The start pose of causal tracking: detecting its end, and cutting it out of a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import rotations
from ..filters.phases import SWAYS_DEG, SWAYS_DEG_S
from ..recording import Intervals, OrientationSensor, Recording
from ..recording.arrivals import list_numbers, unpack_orientations

START_POSE_HOLD_S = 3.0  # [s] of standing still for a start pose that is not stated
CHECK_PERIOD_S = 0.1  # [s] between two checks for motion
CHECK_WINDOW_S = 0.5  # [s] newest samples that a check uses


class StartPoseDetector:
    """Detects a start pose that is not stated: `START_POSE_HOLD_S` in which no sensor moves or is lost.

    Parameters
    ----------
    measured : (k,) bool: the sensors with measured orientations, whose rates are those from one tick to the next

    Attributes
    ----------
    state : "waiting" for sensors, "start_pose", "moved" (in the last second), "ready"
    held_s : [s] of standing still so far
    missing, moving : columns of the sensors that are lost, and of those that moved last
    """

    def __init__(self, rate_hz: float, measured: np.ndarray, hold_s: float = START_POSE_HOLD_S) -> None:
        self.state, self.missing, self.moving = "waiting", tuple(range(len(measured))), tuple[int, ...]()
        self._measured, self._rate, self._hold = measured, rate_hz, round(hold_s * rate_hz)
        self._every, self._window = max(1, round(CHECK_PERIOD_S * rate_hz)), max(4, round(CHECK_WINDOW_S * rate_hz))
        self._gyro = np.zeros((self._hold, len(measured), 3))
        self._last_quat: np.ndarray | None = None  # of the measured ones
        self._held = 0
        self._tick = 0
        self._moved_at = -np.inf

    @property
    def held_s(self) -> float:
        return self._held / self._rate

    @property
    def begin(self) -> int:
        """First tick of standing still."""
        return self._tick - self._held

    @property
    def end(self) -> int:
        """The last tick so far."""
        return self._tick - 1

    def push(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> int | None:
        """Add ticks, (n, k, 3) [rad/s] and [m/s²] or packed orientations, NaN where lost.

        Return the row of the tick at which the pose was held so long, after which none may be added; None: not yet.
        """
        for row, tick in enumerate(zip(gyro_S, accel_S, strict=True)):
            self._push_tick(*tick)
            if self.state == "ready":
                return row
        return None

    def _push_tick(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> None:
        self._tick += 1
        if self._measured.any():
            gyro_S = self._find_measured_rates(gyro_S, accel_S)
        self.missing = tuple(np.flatnonzero(~np.isfinite(gyro_S).all(axis=1)).tolist())
        if self.missing:
            self.state, self._held = "waiting", 0
            return
        self._gyro[self._held] = gyro_S
        self._held += 1
        if self._held % self._every == 0 or self._held == self._hold:
            rates = self._gyro[: self._held]
            last = rates[-self._window :]
            mean, degrees = rates.mean(axis=0), np.degrees(1.0)
            rate = degrees * np.sqrt(np.mean(np.sum((last - last.mean(axis=0)) ** 2, axis=2), axis=0))
            turned = degrees * np.linalg.norm(np.cumsum(rates - mean, axis=0) / self._rate, axis=2).max(axis=0)
            steady = degrees * np.linalg.norm(mean, axis=1)
            moves = (rate > SWAYS_DEG_S) | (turned > SWAYS_DEG) | (steady > SWAYS_DEG_S)
            if moves.any():
                self.moving = tuple(np.flatnonzero(moves).tolist())
                self._held, self._moved_at = 0, self._tick
        if self._held == self._hold:
            self.state = "ready"
        else:
            self.state = "moved" if self._tick - self._moved_at < self._rate else "start_pose"

    def _find_measured_rates(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Return `gyro_S` with the rates of measured orientations since the last tick; zero at the first."""
        quat = unpack_orientations(gyro_S[self._measured], accel_S[self._measured])
        last, self._last_quat = quat if self._last_quat is None else self._last_quat, quat
        rates = gyro_S.copy()
        rates[self._measured] = rotations.log(rotations.multiply(rotations.conjugate(last), quat)) * self._rate
        return rates


def split_start_pose(received: Recording) -> tuple[Recording, Recording] | None:
    """Return a recording up to the end of its start pose, and what follows; None: the start pose has not ended.

    The first has a phase `static` too, where that ends before it does. The start pose is `phases.start`, else the first
    one that is found.
    """
    is_stated = bool(received.phases.get("start"))
    if is_stated:
        interval = received.phases["start"][0]
        if received.time[-1] < interval[1] - 1e-9:
            return None
    else:
        measured = [isinstance(sensor, OrientationSensor) for sensor in received.sensors.values()]
        detector = StartPoseDetector(received.rate_hz, np.array(measured))
        numbers = zip(*map(list_numbers, received.sensors.values()), strict=True)
        if detector.push(*(np.stack(columns, axis=1) for columns in numbers)) is None:
            return None
        interval = float(received.time[detector.begin]), float(received.time[detector.end])
    span, before = received.span(interval), dict[str, Intervals](start=(interval,))
    begin, static = span.start, received.phases.get("static", ())
    if static and static[0][1] <= interval[1]:
        before["static"] = static[:1]
        begin = min(begin, received.span(static[0]).start)
    start = replace(received.cut(slice(begin, span.stop)), phases=before, start_is_guessed=not is_stated)
    return start, received.cut(slice(span.stop, len(received)))
