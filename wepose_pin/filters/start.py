"""Start of a filter: the tilt in the start phase, from which it runs forward, and backward over earlier samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .. import rotations
from ..compilation import compiled
from ..errors import BadData
from .noise import BLOCK_S, SensorNoise, average_blocks

ACCEL_BIAS_STD = 0.003  # [rad] tilt error from the bias of a calibrated MEMS accelerometer (3 mg: our assumption)
MOVING_TILT_STD = 0.2  # [rad] tilt error of an accelerometer in motion


class StartTilt(NamedTuple):
    """Orientation of a sensor before the first sample of its start phase."""

    quat_VS: np.ndarray  # (4,) xyzw, zero heading
    tilt_std: float  # [rad] one standard deviation of roll and of pitch


def estimate_start_tilt(gyro_S: np.ndarray, accel_S: np.ndarray, noise: SensorNoise, rate_hz: float) -> StartTilt:
    """Estimate the tilt before the first of some static samples from their mean specific force.

    The gyroscope rotates each sample's force into the sensor frame of the first, so that sway does not blur the mean.
    NaN samples are left out.

    Parameters
    ----------
    gyro_S, accel_S : (n, 3) [rad/s], (n, 3) [m/s²]

    Raises
    ------
    BadData
        The samples have no gravity.
    """
    gyro, accel = np.ascontiguousarray(gyro_S), np.ascontiguousarray(accel_S)
    force = _turn_to_first(gyro, accel, noise.gyro_bias, 1.0 / rate_hz)
    mean = average_blocks(force, len(force))[0] if len(force) else np.zeros(3)
    norm = float(np.linalg.norm(mean))
    if not norm > 0.0:
        raise BadData("accel is zero in the start phase; the filter starts from the direction of gravity")
    across = force - (force @ mean)[:, None] * mean / norm**2
    size = max(1, round(BLOCK_S * rate_hz))
    blocks = len(across) // size
    if blocks >= 4:
        variance = float(average_blocks(across, size).var(axis=0, ddof=1).sum()) / 2.0 / blocks
    else:  # too short for sway to average out
        variance = float(across.var(axis=0).sum()) / 2.0
    return StartTilt(rotations.quat_from_gravity(mean), float(np.hypot(ACCEL_BIAS_STD, np.sqrt(variance) / norm)))


@compiled
def _turn_to_first(gyro_S, accel_S, bias, dt):  # type: ignore[no-untyped-def]
    """Specific forces (m, 3) of the samples without NaN, in the sensor frame before the first sample."""
    quat, R, out, count = np.array([0.0, 0.0, 0.0, 1.0]), np.empty((3, 3)), np.empty_like(accel_S), 0
    for k in range(len(gyro_S)):
        x, y, z = (gyro_S[k, 0] - bias[0]) * dt, (gyro_S[k, 1] - bias[1]) * dt, (gyro_S[k, 2] - bias[2]) * dt
        x, y, z = x if np.isfinite(x) else 0.0, y if np.isfinite(y) else 0.0, z if np.isfinite(z) else 0.0
        rotations.rotate_by_vector(quat, x, y, z)
        a, b, c = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        if np.isfinite(a + b + c):
            rotations.fill_matrix(quat, R)
            for i in range(3):
                out[count, i] = R[i, 0] * a + R[i, 1] * b + R[i, 2] * c
            count += 1
    return out[:count]
