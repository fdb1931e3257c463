"""GDC: gradient-descent filter without magnetometer (Madgwick, Harrison, Vaidyanathan 2011, ICORR).

Their equations (25), (26), (32) to (34): q̇ = ½ q ⊗ (gyro − b) − β ∇f/‖∇f‖ with f = R_VSᵀ e_z − a. The bias is the
static phase's and stays; their bias step needs a magnetometer. Of ∇f only the part across q is taken: the part along q
turns nothing, and in their f, which counts on ‖q‖ = 1, its size depends on how the sensor's axes lie.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..compilation import inlined, kernel
from ..recording.limits import HIGHEST_RATE_SQUARED
from ..rotations import derivative, up_in_sensor
from .base import FilterRun, FilterState, make_run, prepare_samples
from .noise import SensorNoise


@dataclass(frozen=True)
class GdcParams:
    """The gain that Madgwick 2011 found best for an IMU."""

    gain: float = 0.033  # [1/s] β


class Gdc:
    """GDC of one sensor; the bias is the static phase's mean. A sample that is no number is passed over."""

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, params: GdcParams | None = None
    ) -> None:
        self.params = params or GdcParams()
        self.rate_hz = rate_hz
        self.state = FilterState(np.array(quat_VS, dtype=float), noise.gyro_bias.copy())

    def run(
        self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool, out: FilterRun | None = None
    ) -> FilterRun:
        gyro, accel, _ = prepare_samples(gyro_S, accel_S, static)
        out = out or make_run(len(gyro), covariance=False)
        out.gyro_bias[:] = self.state.gyro_bias
        _run(self.state.quat_VS, self.state.gyro_bias, gyro, accel, 1.0 / self.rate_hz, self.params.gain, out.quat_VS)
        return out


@kernel
def _run(quat, bias, gyro_S, accel_S, dt, gain, out_quat):  # type: ignore[no-untyped-def]
    for k in range(len(gyro_S)):
        wx, wy, wz = gyro_S[k, 0] - bias[0], gyro_S[k, 1] - bias[1], gyro_S[k, 2] - bias[2]
        if wx * wx + wy * wy + wz * wz < HIGHEST_RATE_SQUARED:  # false for NaN
            _step(quat, wx, wy, wz, accel_S[k, 0], accel_S[k, 1], accel_S[k, 2], dt, gain)
        for i in range(4):
            out_quat[k, i] = quat[i]


@inlined
def _step(quat, wx, wy, wz, ax, ay, az, dt, gain):  # type: ignore[no-untyped-def]
    x, y, z, w = quat[0], quat[1], quat[2], quat[3]
    dx, dy, dz, dw = derivative(x, y, z, w, wx, wy, wz)
    norm = np.sqrt(ax * ax + ay * ay + az * az)
    if 0.0 < norm < np.inf:  # in free fall there is no direction to descend
        ux, uy, uz = up_in_sensor(quat)
        f1, f2, f3 = ux - ax / norm, uy - ay / norm, uz - az / norm
        gw = -2.0 * y * f1 + 2.0 * x * f2  # ∇f = Jᵀ f
        gx = 2.0 * z * f1 + 2.0 * w * f2 - 4.0 * x * f3
        gy = -2.0 * w * f1 + 2.0 * z * f2 - 4.0 * y * f3
        gz = 2.0 * x * f1 + 2.0 * y * f2
        along = gw * w + gx * x + gy * y + gz * z
        gw, gx, gy, gz = gw - along * w, gx - along * x, gy - along * y, gz - along * z
        steep = np.sqrt(gw * gw + gx * gx + gy * gy + gz * gz)
        if steep > 0.0:
            dx -= gain * gx / steep
            dy -= gain * gy / steep
            dz -= gain * gz / steep
            dw -= gain * gw / steep
    x, y, z, w = x + dx * dt, y + dy * dt, z + dz * dt, w + dw * dt
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    quat[0], quat[1], quat[2], quat[3] = x / norm, y / norm, z / norm, w / norm
