"""NCF: the nonlinear (explicit) complementary filter with integral term (Mahony, Hamel, Pflimlin 2008, IEEE TAC 53(5)).

Their equation (32) with gravity as the only measured direction: e = a × R_VSᵀ e_z with a the unit accelerometer
direction, ω = gyro − b + k_P e, ḃ = −k_I e.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..compilation import kernel
from ..recording.limits import HIGHEST_RATE_SQUARED
from ..rotations import rotate_by_vector, up_in_sensor
from .base import FilterRun, FilterState, make_run, prepare_samples
from .noise import SensorNoise


@dataclass(frozen=True)
class NcfParams:
    """Gains as tuned on many recordings by Laidig and Seel 2023 (VQF, Information Fusion 91, the Mahony baseline)."""

    proportional: float = 0.74  # [1/s] k_P
    integral: float = 0.0012  # [1/s²] k_I


class Ncf:
    """NCF of one sensor; the bias starts at the static phase's mean. A sample that is no number is passed over."""

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, params: NcfParams | None = None
    ) -> None:
        self.params = params or NcfParams()
        self.rate_hz = rate_hz
        self.state = FilterState(np.array(quat_VS, dtype=float), noise.gyro_bias.copy())

    def run(
        self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool, out: FilterRun | None = None
    ) -> FilterRun:
        gyro, accel, _ = prepare_samples(gyro_S, accel_S, static)
        out = out or make_run(len(gyro), covariance=False)
        state, gains = self.state, (self.params.proportional, self.params.integral)
        _run(state.quat_VS, state.gyro_bias, gyro, accel, 1.0 / self.rate_hz, *gains, out.quat_VS, out.gyro_bias)
        return out


@kernel
def _run(quat, bias, gyro_S, accel_S, dt, proportional, integral, out_quat, out_bias):  # type: ignore[no-untyped-def]
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        if gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED:  # false for NaN
            norm = np.sqrt(ax * ax + ay * ay + az * az)
            ex = ey = ez = 0.0
            if 0.0 < norm < np.inf:  # in free fall there is no direction to follow
                ux, uy, uz = up_in_sensor(quat)
                ex = (ay * uz - az * uy) / norm
                ey = (az * ux - ax * uz) / norm
                ez = (ax * uy - ay * ux) / norm
            rotate_by_vector(
                quat,
                (gx - bias[0] + proportional * ex) * dt,
                (gy - bias[1] + proportional * ey) * dt,
                (gz - bias[2] + proportional * ez) * dt,
            )
            bias[0] -= integral * ex * dt
            bias[1] -= integral * ey * dt
            bias[2] -= integral * ez * dt
        for i in range(4):
            out_quat[k, i] = quat[i]
        for i in range(3):
            out_bias[k, i] = bias[i]
