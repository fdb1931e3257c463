"""sMEKF: the multiplicative Kalman filter that corrects in static phases alone (Lisini Baldi 2019, Algorithm 1).

One thing differs from the paper, which works to first order (`published`). Its transition Φ = I − [ω δt]× lets the
standard deviation grow by √(1 + (ω δt)²) a sample, at 720 deg/s and 100 Hz to 10⁶ deg in 20 s. Its corrections rotate
the attitude and not the covariance, so that static phases seem to measure the heading. Over two minutes of simulated
motion with static phases the rms heading error is 0.57 deg as published and 0.10 deg here.

The state is x = [a; b]: the attitude error a [rad] and the gyroscope bias b [rad/s] in S. The paper's a is on the
right of `quat_VS`, in S, as that of `attitude_cov`. Inside, a is on the left, in V, where it changes neither with the
sensor's rotation nor with a correction of the attitude: Φ is the identity and P need not be rotated.

Measurement model: gyro = ω + b + w_ω, accel/g = R_VSᵀ e_z + w_g. In a static phase ω = 0, so gyro measures b. The white
noises w_ω, w_g and the bias's random walk have one variance on all axes, the mean of those of Σ_ω, Σ_g and Σ_b. A
person's sway and the accelerometer's bias are correlated from sample to sample, so that the variances of static samples
are inflated: many samples of a static phase count as few.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arguments import NonNegative, PositiveOrInfinite
from ..compilation import fma, inlined, kernel
from ..recording.limits import HIGHEST_ACCEL_SQUARED
from ..rotations import fill_matrix, rotate_by_world_vector, rotate_unit_by_rate
from .base import (
    HEADING,
    RATE,
    RATE_VAR,
    START_HEADING_STD,
    STATIC_TURN_NOISE,
    FilterParams,
    OrientationFilter,
    bridge_rate,
    into_sensor,
    make_record,
)
from .noise import ACCEL_BIAS_STD, SWAY_CORRELATION_S


@dataclass(frozen=True)
class SmekfParams(FilterParams):
    """What the static phase does not say of a sensor; standard deviations."""

    tilt_std: NonNegative = ACCEL_BIAS_STD  # [rad] of roll and pitch at the start
    static_turn_noise: NonNegative = STATIC_TURN_NOISE  # [rad/√s] of undetected rotation about the vertical
    gyro_scale_std: NonNegative = 0.002  # of the gyroscope's scale, which no static phase shows
    gyro_range: PositiveOrInfinite = np.inf  # [rad/s] full scale; at it the covariance grows by what may be beyond


# P is symmetric; each entry is computed once, with `fma`: that is most of the time of a step.


@inlined
def _predict(state, model, lost_var):  # type: ignore[no-untyped-def]
    """Algorithm 1, prediction: P ← F P Fᵀ + Q with F = [[I, −δt R_VS], [0, I]] of errors a in V and b in S."""
    P, R, dt = state.P, state.R_VS, model.dt
    for i in range(3):
        x, y, z = dt * R[i, 0], dt * R[i, 1], dt * R[i, 2]
        for j in range(i, 3):
            P[i, j] = fma(-x, P[j, 3], fma(-y, P[j, 4], fma(-z, P[j, 5], P[i, j])))
    for i in range(3):
        x, y, z = dt * R[i, 0], dt * R[i, 1], dt * R[i, 2]
        for j in range(3, 6):
            P[i, j] = fma(-x, P[3, j], fma(-y, P[4, j], fma(-z, P[5, j], P[i, j])))
            P[j, i] = P[i, j]
    for i in range(3):
        x, y, z = dt * P[i, 3], dt * P[i, 4], dt * P[i, 5]
        for j in range(i, 3):
            P[i, j] = fma(-x, R[j, 0], fma(-y, R[j, 1], fma(-z, R[j, 2], P[i, j])))
            P[j, i] = P[i, j]
        P[i, i] += model.attitude_var + lost_var
        P[3 + i, 3 + i] += model.bias_var


@inlined
def _correct(state, model, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Algorithm 1, correction in a static phase, by one measurement after the other.

    y = [R_VS accel/g; gyro], h = [e_z; b̂], H = [[[e_z]×, 0], [0, I]] of errors in V. A correction of the attitude does
    not change e_z, so that P, whose long axis is the heading, need not follow it. The vertical part of accel measures
    nothing of the state.
    """
    P, x, R, bias, g = state.P, state.x, state.R_VS, state.gyro_bias, model.inverse_gravity
    for i in range(6):
        x[i] = 0.0
    _fuse(P, x, 3, model.static_gyro_var, gx - bias[0])
    _fuse(P, x, 4, model.static_gyro_var, gy - bias[1])
    _fuse(P, x, 5, model.static_gyro_var, gz - bias[2])
    _fuse(P, x, 1, model.static_accel_var, -g * (R[0, 0] * ax + R[0, 1] * ay + R[0, 2] * az))
    _fuse(P, x, 0, model.static_accel_var, g * (R[1, 0] * ax + R[1, 1] * ay + R[1, 2] * az))
    P[2, 2] += model.static_turn_var
    state.about_vertical[HEADING] += x[2]
    for i in range(3):
        state.about_vertical[RATE] += R[2, i] * x[3 + i]
        bias[i] += x[3 + i]
    rotate_by_world_vector(state.quat_VS, x[0], x[1], x[2])
    fill_matrix(state.quat_VS, R)


@inlined
def _fuse(P, x, at, variance, measured):  # type: ignore[no-untyped-def]
    """Correct by a measurement of one state, P h = p, s its variance: x ← x + p y/s and P ← P − p pᵀ/s."""
    share = 1.0 / (P[at, at] + variance)
    gain = share * (measured - x[at])
    p = (P[at, 0], P[at, 1], P[at, 2], P[at, 3], P[at, 4], P[at, 5])
    for i in range(6):
        x[i] += gain * p[i]
        factor = share * p[i]
        for j in range(i, 6):
            P[i, j] = fma(-factor, p[j], P[i, j])
            P[j, i] = P[i, j]


@kernel
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    state, model = states[0], models[0]
    quat, bias, R, P, vertical, dt = (
        state.quat_VS, state.gyro_bias, state.R_VS, state.P, state.about_vertical, model.dt
    )  # fmt: skip
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        wx, wy, wz, is_measured, lost_var = bridge_rate(state, model, gx, gy, gz, bias[0], bias[1], bias[2])
        rotate_unit_by_rate(quat, wx, wy, wz, dt)
        fill_matrix(quat, R)
        _predict(state, model, lost_var)
        if static[k] and is_measured and ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
            _correct(state, model, gx, gy, gz, ax, ay, az)
        # A scale of the gyroscope that is wrong by s gives the heading an error of s times the rotation about the
        # vertical. The scale is no part of the filter's state, as in the paper.
        state.turned += dt * (R[2, 0] * wx + R[2, 1] * wy + R[2, 2] * wz)
        attitude = P[0, 0], P[0, 1], P[0, 2], P[1, 0], P[1, 1], P[1, 2], P[2, 0], P[2, 1], P[2, 2]
        into_sensor(R, attitude, 0.0, model.scale_var * state.turned * state.turned, out_cov[k])
        x, y, z = R[2, 0], R[2, 1], R[2, 2]
        vertical[RATE_VAR] = P[3, 3] * x * x + P[4, 4] * y * y + P[5, 5] * z * z
        vertical[RATE_VAR] += 2.0 * (P[3, 4] * x * y + P[3, 5] * x * z + P[4, 5] * y * z)
        for i in range(3):
            out_bias[k, i], out_vertical[k, i] = bias[i], vertical[i]
        for i in range(4):
            out_quat[k, i] = quat[i]


class Smekf(OrientationFilter):
    """sMEKF of one sensor. Noise, the first bias and the size of gravity come from `noise`.

    While gyro is lost, its last rate is held and fades, and `attitude_cov` grows by the motion that may have been
    missed (`base.HOLD_S`, `base.LOST_RATE_STD`).
    """

    params_type, _run = SmekfParams, staticmethod(_run)

    def _make_records(self, quat_VS: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        noise, p, rate_hz = self.noise, self.params, self.rate_hz
        P = np.zeros((6, 6))
        np.fill_diagonal(P, np.square([p.tilt_std, p.tilt_std, START_HEADING_STD, 0.0, 0.0, 0.0]))
        P[3:, 3:] = noise.gyro_bias_cov
        state = make_record(
            quat_VS=quat_VS,  # (4,) xyzw
            gyro_bias=noise.gyro_bias,  # (3,) [rad/s]
            P=P,  # of a in V [rad] and b in S [rad/s]
            x=np.zeros(6),  # their correction
            turned=0.0,  # [rad] net rotation about the vertical since the start
            last_rate=np.zeros(3),  # [rad/s] as `bridge_rate`
            lost_s=0.0,  # [s] the same
            about_vertical=np.array([0.0, 0.0, np.trace(noise.gyro_bias_cov) / 3.0]),  # as `Orientation`
            R_VS=np.zeros((3, 3)),
        )
        gyro_var, accel_var, step_var = (
            float(np.trace(cov)) / 3.0 for cov in (noise.gyro_cov, noise.accel_cov, noise.bias_step_cov)
        )
        model = make_record(
            dt=1.0 / rate_hz,  # [s]
            inverse_gravity=1.0 / noise.gravity,  # [s²/m]
            attitude_var=gyro_var / rate_hz**2,  # [rad²] of a sample
            bias_var=step_var / rate_hz**2,  # [rad²/s²] of a sample
            static_gyro_var=gyro_var + noise.sway_density(rate_hz) * rate_hz,  # [rad²/s²]
            static_accel_var=accel_var + ACCEL_BIAS_STD**2 * SWAY_CORRELATION_S * rate_hz,  # [1]
            static_turn_var=p.static_turn_noise**2 / rate_hz,  # [rad²] of a sample
            scale_var=p.gyro_scale_std**2,
            gyro_range=p.gyro_range,  # [rad/s]
        )
        return state, model
