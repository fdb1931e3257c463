"""The start pose of causal tracking: detecting its end, and cutting it out of a recording."""

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
        self._held, self._tick, self._moved_at = 0, 0, -np.inf

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
        rates = gyro_S
        if self._measured.any() and len(gyro_S):  # since the last tick; zero at the first
            quat = unpack_orientations(gyro_S[:, self._measured], accel_S[:, self._measured])
            quat = np.concatenate([quat[:1] if self._last_quat is None else self._last_quat, quat])
            turns = rotations.log(rotations.multiply(rotations.conjugate(quat[:-1]), quat[1:]))
            rates, self._last_quat = gyro_S.copy(), quat[-1:]
            rates[:, self._measured] = turns * self._rate
        for row, rate in enumerate(rates):
            self._tick += 1
            self.missing = tuple(np.flatnonzero(~np.isfinite(rate).all(axis=1)).tolist())
            if self.missing:
                self.state, self._held = "waiting", 0
                continue
            self._gyro[self._held] = rate
            self._held += 1
            if self._held % self._every == 0 or self._held == self._hold:
                self._check_motion(self._gyro[: self._held])
            if self._held == self._hold:
                self.state = "ready"
                return row
            self.state = "moved" if self._tick - self._moved_at < self._rate else "start_pose"
        return None

    def _check_motion(self, rates: np.ndarray) -> None:
        """Begin again where a sensor moves by its rates (n, k, 3) [rad/s]."""
        last, mean, degrees = rates[-self._window :], rates.mean(axis=0), np.degrees(1.0)
        rate = degrees * np.sqrt(np.mean(np.sum((last - last.mean(axis=0)) ** 2, axis=2), axis=0))
        turned = degrees * np.linalg.norm(np.cumsum(rates - mean, axis=0) / self._rate, axis=2).max(axis=0)
        moves = (rate > SWAYS_DEG_S) | (turned > SWAYS_DEG) | (degrees * np.linalg.norm(mean, axis=1) > SWAYS_DEG_S)
        if moves.any():
            self.moving = tuple(np.flatnonzero(moves).tolist())
            self._held, self._moved_at = 0, self._tick


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
