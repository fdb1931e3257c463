"""Lost samples, and resampling: short gaps are bridged silently, long gaps are bridged and marked.

A sample is lost when its row is missing (a long step in time) or its cells are empty. Gaps of up to
`clocks.LONGEST_GAP_S` are bridged: rate and specific force linearly, measured orientations along the shortest rotation.
A longer gap is an error, or is bridged and marked where the user allows it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .. import rotations
from .clocks import UNEVEN, Clock
from .sensors import OrientationSensor, Sensor

# In a long gap the rate fades to the static sensor's rate within this time [s]: a movement lasts no longer.
FADE_S = 0.1

GOOD, BRIDGED, LONG = 0, 1, 2


def mark_lost_samples(clock: Clock, good: np.ndarray) -> np.ndarray:
    """Mark every sample (n,) as `GOOD`, `BRIDGED` or `LONG`, by the length of the runs that are not `good` (n,)."""
    marks = np.zeros(len(good), dtype=np.int8)
    for first, last in find_runs(~good):
        marks[first:last] = LONG if (last - first) * clock.step > clock.longest_bridge else BRIDGED
    return marks


def find_runs(which: np.ndarray) -> list[tuple[int, int]]:
    """Find the runs of true values; returns the first and one past the last index of each."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def bridge(values: np.ndarray, marks: np.ndarray, clock: Clock, *, rate: bool = False) -> np.ndarray:
    """Fill lost samples of `values` (n, k) linearly in time; at the ends with the nearest value.

    With `rate` the values are angular rates,
    which in long gaps fade to the rate of the static sensor, its bias.
    """
    lost = marks != GOOD
    if not lost.any():
        return values
    time, filled = clock.time, values.copy()
    for k in range(values.shape[1]):
        filled[lost, k] = np.interp(time[lost], time[~lost], values[~lost, k])
    if rate and (marks == LONG).any():
        second = find_static_second(values, ~lost, 1.0 / clock.step)
        static = values[second].mean(axis=0) if len(second) else np.zeros(values.shape[1])
        for first, last in find_runs(marks == LONG):
            edges = [edge for edge in (first - 1, last) if 0 <= edge < len(time)]
            near = [np.clip(1.0 - np.abs(time[first:last] - time[edge]) / FADE_S, 0.0, None) for edge in edges]
            whole = np.maximum(1.0, np.sum(near, axis=0))
            filled[first:last] = static
            for edge, weight in zip(edges, near, strict=True):
                filled[first:last] += (weight / whole)[:, None] * (values[edge] - static)
    return filled


def bridge_quat(quat: np.ndarray, marks: np.ndarray, clock: Clock) -> np.ndarray:
    """Fill lost unit quaternions of `quat` (n, 4) along the shortest rotation; at the ends with the nearest one."""
    filled = quat.copy()
    for first, last in find_runs(marks != GOOD):
        if first == 0 or last == len(quat):
            filled[first:last] = quat[last] if first == 0 else quat[first - 1]
            continue
        edges = [first - 1, last]
        turn = Slerp(clock.time[edges], Rotation.from_quat(quat[edges]))
        filled[first:last] = turn(clock.time[first:last]).as_quat()
    return filled


def find_static_second(gyro_S: np.ndarray, good: np.ndarray, rate_hz: float) -> np.ndarray:
    """Find the samples of the second, without any that is not `good` (n,), in which the rate (n, 3) varies least.

    They are none where each second has a sample that is not good.
    """
    size = min(len(gyro_S), max(2, round(rate_hz)))
    count = len(gyro_S) // size
    motion = gyro_S[: count * size].reshape(count, size, 3).var(axis=1).sum(axis=1)
    motion[~good[: count * size].reshape(count, size).all(axis=1)] = np.inf
    first = int(np.argmin(motion))
    return np.arange(first * size, (first + 1) * size) if np.isfinite(motion[first]) else np.empty(0, dtype=int)


# Resampling, which preserves total rotation --------------------------------------------------------------------------


def resample(sensor: Sensor, clock: np.ndarray, time: np.ndarray) -> Sensor:
    """Resample a sensor from its own times `clock` (n,) [s] to an even time base `time` (m,) within them.

    The rate is integrated on the sensor's clock, the orientation is interpolated at constant rate in each interval, and
    differenced again; this preserves total rotation. The specific force is interpolated linearly; on a coarser time
    base it is averaged over each step, so that noise and impacts between samples do not alias.
    """
    gap = None
    if sensor.gap is not None:
        after = np.clip(np.searchsorted(clock, time - 1e-9), 0, len(clock) - 1)
        gap = sensor.gap[after] | (sensor.gap[np.maximum(after - 1, 0)] & (clock[after] > time + 1e-9))
    within = np.clip(time, clock[0], clock[-1])
    if isinstance(sensor, OrientationSensor):
        return replace(sensor, quat_VS=Slerp(clock, Rotation.from_quat(sensor.quat_VS))(within).as_quat(), gap=gap)
    quat = rotations.integrate(sensor.gyro_S[1:] * np.diff(clock)[:, None])
    R = Slerp(clock, Rotation.from_quat(quat))(within)
    rate = rotations.compute_turns(R.as_quat()) / np.diff(time)[:, None]
    dt = float(time[1] - time[0])
    if dt < (1.0 + UNEVEN) * float(np.median(np.diff(clock))):
        accel = np.column_stack([np.interp(within, clock, axis) for axis in sensor.accel_S.T])
    else:
        accel = _average(sensor.accel_S, clock, within, dt)
    return replace(sensor, gyro_S=np.concatenate([rate[:1], rate]), accel_S=accel, gap=gap)


def _average(values: np.ndarray, clock: np.ndarray, time: np.ndarray, width: float) -> np.ndarray:
    """Average (m, k) the piecewise linear signal over `width` [s] around each time; shorter at the clock's ends."""
    trapezes = 0.5 * (values[1:] + values[:-1]) * np.diff(clock)[:, None]
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(trapezes, axis=0)])
    first, last = (np.clip(time + side * width / 2.0, clock[0], clock[-1]) for side in (-1.0, 1.0))

    def integrate_to(t: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(clock, t, side="right") - 1, 0, len(clock) - 2)
        part = (t - clock[k])[:, None]
        slope = (values[k + 1] - values[k]) / (clock[k + 1] - clock[k])[:, None]
        return integral[k] + part * (values[k] + 0.5 * part * slope)

    return (integrate_to(last) - integrate_to(first)) / (last - first)[:, None]
