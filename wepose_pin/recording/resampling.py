"""Resampling of a sensor to another time base; total rotation is preserved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .. import rotations
from .clocks import UNEVEN
from .sensors import OrientationSensor, Sensor


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
