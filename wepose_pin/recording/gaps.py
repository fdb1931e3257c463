"""Lost samples, and resampling: short gaps are bridged silently, long gaps are bridged and marked.

A sample is lost when its row is missing (a long step in time) or its cells are empty. Gaps of up to
`clocks.LONGEST_GAP_S` are bridged: rate and specific force linearly, measured orientations along the shortest rotation.
A longer gap is an error, or is bridged and marked where the user allows it: filters take no sample in it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .. import rotations
from .clocks import UNEVEN, Clock
from .sensors import OrientationSensor, Sensor

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


def bridge(values: np.ndarray, marks: np.ndarray, clock: Clock) -> np.ndarray:
    """Fill lost samples of `values` (n, k) linearly in time; at the ends with the nearest value."""
    lost = marks != GOOD
    if not lost.any():
        return values
    filled = values.copy()
    for k in range(values.shape[1]):
        filled[lost, k] = np.interp(clock.time[lost], clock.time[~lost], values[~lost, k])
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


# Resampling, which preserves total rotation --------------------------------------------------------------------------


def resample(sensor: Sensor, clock: np.ndarray, time: np.ndarray) -> Sensor:
    """Resample a sensor from its own times `clock` (n,) [s] to an even time base `time` (m,) within them.

    The rate is integrated, interpolated as an orientation and differenced again, which preserves total rotation. The
    specific force is interpolated linearly; on a coarser time base it is averaged over each step against aliasing.
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
        # A mean over each step is the difference of integrals at its ends.
        trapezes = 0.5 * (sensor.accel_S[1:] + sensor.accel_S[:-1]) * np.diff(clock)[:, None]
        integral = np.concatenate([np.zeros((1, 3)), np.cumsum(trapezes, axis=0)])
        first, last = (np.clip(time + side * dt / 2.0, clock[0], clock[-1]) for side in (-1.0, 1.0))
        accel = np.column_stack([np.interp(last, clock, axis) - np.interp(first, clock, axis) for axis in integral.T])
        accel /= (last - first)[:, None]
    return replace(sensor, gyro_S=np.concatenate([rate[:1], rate]), accel_S=accel, gap=gap)
