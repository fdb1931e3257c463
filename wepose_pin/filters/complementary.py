"""Filters with fixed gains, without covariance. A sample that is no number is passed over.

NCF is the nonlinear (explicit) complementary filter with integral term (Mahony, Hamel, Pflimlin 2008, IEEE TAC 53(5)),
equation (32) with gravity as the only measured direction: e = a × R_VSᵀ e_z with a the unit accelerometer direction,
ω = gyro − b + k_P e, ḃ = −k_I e.

GDC is the gradient-descent filter without magnetometer (Madgwick, Harrison, Vaidyanathan 2011, ICORR), equations (25),
(26), (32) to (34): q̇ = ½ q ⊗ (gyro − b) − β ∇f/‖∇f‖ with f = R_VSᵀ e_z − a. The bias is the static phase's and stays;
their bias step needs a magnetometer. Of ∇f only the part across q is taken: the part along q turns nothing, and in
their f, which counts on ‖q‖ = 1, its size depends on how the sensor's axes lie.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arguments import NonNegative
from ..compilation import inlined, kernel
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


@inlined
def _step_ncf(state, model, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    quat, bias = state.quat_VS, state.gyro_bias
    dt, proportional, integral = model.dt, model.proportional, model.integral
    norm = np.sqrt(ax * ax + ay * ay + az * az)
    ex = ey = ez = 0.0
    if 0.0 < norm < np.inf:  # in free fall there is no direction to follow
        ux, uy, uz = up_in_sensor(quat)
        ex, ey, ez = (ay * uz - az * uy) / norm, (az * ux - ax * uz) / norm, (ax * uy - ay * ux) / norm
    rotate_by_vector(
        quat,
        (gx - bias[0] + proportional * ex) * dt,
        (gy - bias[1] + proportional * ey) * dt,
        (gz - bias[2] + proportional * ez) * dt,
    )
    bias[0] -= integral * ex * dt
    bias[1] -= integral * ey * dt
    bias[2] -= integral * ez * dt


@inlined
def _step_gdc(state, model, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    quat, bias, dt = state.quat_VS, state.gyro_bias, model.dt
    x, y, z, w = quat[0], quat[1], quat[2], quat[3]
    dx, dy, dz, dw = product(x, y, z, w, 0.5 * (gx - bias[0]), 0.5 * (gy - bias[1]), 0.5 * (gz - bias[2]), 0.0)
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
            share = model.gain / steep
            dx, dy, dz, dw = dx - share * gx, dy - share * gy, dz - share * gz, dw - share * gw
    x, y, z, w = x + dx * dt, y + dy * dt, z + dz * dt, w + dw * dt
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    quat[0], quat[1], quat[2], quat[3] = x / norm, y / norm, z / norm, w / norm


@kernel
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias):  # type: ignore[no-untyped-def]  # noqa: ARG001
    state, model = states[0], models[0]
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        if gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED:  # false for NaN
            if model.gain > 0.0:
                _step_gdc(state, model, gx, gy, gz, ax, ay, az)
            else:
                _step_ncf(state, model, gx, gy, gz, ax, ay, az)
        for i in range(4):
            out_quat[k, i] = state.quat_VS[i]
        for i in range(3):
            out_bias[k, i] = state.gyro_bias[i]


def _make_records(
    noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, params: NcfParams | GdcParams
) -> tuple[np.ndarray, ...]:
    gains = {"proportional": 0.0, "integral": 0.0, "gain": 0.0} | vars(params)
    state = make_record(quat_VS=quat_VS, gyro_bias=noise.gyro_bias)  # the bias starts at the static phase's mean
    return state, make_record(dt=1.0 / rate_hz, **gains)


NCF = OrientationFilter(_make_records, _run, NcfParams, has_covariance=False)
GDC = OrientationFilter(_make_records, _run, GdcParams, has_covariance=False)
