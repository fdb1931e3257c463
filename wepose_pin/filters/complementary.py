"""Filters with fixed gains, without covariance. A sample that is no number is passed over.

NCF is the nonlinear (explicit) complementary filter with integral term (Mahony, Hamel, Pflimlin 2008, IEEE TAC 53(5)),
equation (32) with gravity as the only measured direction: e = a × R_VSᵀ e_z with a the unit accelerometer direction,
ω = gyro − b + k_P e, ḃ = −k_I e.

GDC is the gradient-descent filter without magnetometer (Madgwick, Harrison, Vaidyanathan 2011, ICORR), equations (25),
(26), (32) to (34): q̇ = ½ q ⊗ (gyro − b) − β ∇f/‖∇f‖ with f = ½ ‖R_VSᵀ e_z − a‖². The part of ∇f along q turns nothing;
across q it is −2 q ⊗ e. So ω = gyro − b + 2 β e/‖e‖: the step of NCF with a correction of constant size. The bias is
the static phase's and stays; their bias step needs a magnetometer.
"""

from dataclasses import dataclass

import numpy as np

from ..arguments import NonNegative
from ..compilation import kernel
from ..recording.limits import HIGHEST_RATE_SQUARED
from ..rotations import product, rotate_by_vector, up_in_sensor
from .base import FilterParams, OrientationFilter, make_record
from .phases import SensorNoise


@dataclass(frozen=True)
class NcfParams(FilterParams):
    """Gains as tuned on many recordings by Laidig and Seel 2023 (VQF, Information Fusion 91, the Mahony baseline)."""

    proportional: NonNegative = 0.74  # [1/s] k_P
    integral: NonNegative = 0.0012  # [1/s²] k_I


@dataclass(frozen=True)
class GdcParams(FilterParams):
    """The gain that Madgwick 2011 found best for an IMU."""

    gain: NonNegative = 0.033  # [1/s] β


@kernel
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias):  # type: ignore[no-untyped-def]  # noqa: ARG001
    quat, bias, dt = states[0].quat_VS, states[0].gyro_bias, models[0].dt
    proportional, integral, constant = models[0].proportional, models[0].integral, 2.0 * models[0].gain
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        if gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED:  # false for NaN
            norm = np.sqrt(ax * ax + ay * ay + az * az)
            ex = ey = ez = 0.0
            if 0.0 < norm < np.inf:  # in free fall there is no direction to follow
                ux, uy, uz = up_in_sensor(quat)
                ex, ey, ez = (ay * uz - az * uy) / norm, (az * ux - ax * uz) / norm, (ax * uy - ay * ux) / norm
            size = np.sqrt(ex * ex + ey * ey + ez * ez)
            gain = proportional + (constant / size if size > 0.0 else 0.0)
            x, y, z = (gx - bias[0] + gain * ex) * dt, (gy - bias[1] + gain * ey) * dt, (gz - bias[2] + gain * ez) * dt
            if constant > 0.0:  # q + q̇ δt, as published
                qx, qy, qz, qw = product(quat[0], quat[1], quat[2], quat[3], 0.5 * x, 0.5 * y, 0.5 * z, 1.0)
                length = np.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
                quat[0], quat[1], quat[2], quat[3] = qx / length, qy / length, qz / length, qw / length
            else:
                rotate_by_vector(quat, x, y, z)
            bias[0] -= integral * ex * dt
            bias[1] -= integral * ey * dt
            bias[2] -= integral * ez * dt
        for i in range(4):
            out_quat[k, i] = quat[i]
        for i in range(3):
            out_bias[k, i] = bias[i]


def _make_records(
    noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, params: NcfParams | GdcParams
) -> tuple[np.ndarray, ...]:
    state = make_record(quat_VS=quat_VS, gyro_bias=noise.gyro_bias)  # the bias starts at the static phase's mean
    gains = {"proportional": 0.0, "integral": 0.0, "gain": 0.0} | vars(params)
    return state, make_record(dt=1.0 / rate_hz, **gains)


NCF = OrientationFilter(_make_records, _run, NcfParams, has_covariance=False)
GDC = OrientationFilter(_make_records, _run, GdcParams, has_covariance=False)
