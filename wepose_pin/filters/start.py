"""Start of a filter: the tilt in the start phase, from which it runs forward, and backward over earlier samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .. import rotations
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
    force = rotations.unroll((gyro_S - noise.gyro_bias) * (1.0 / rate_hz), np.ascontiguousarray(accel_S))
    if not np.isfinite(force).all():
        force = force[np.isfinite(force).all(axis=1)]
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
