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

from ..arguments import NonNegative, PositiveOrInfinite, check_fields
from ..compilation import fma, inlined, kernel
from ..recording.limits import HIGHEST_ACCEL_SQUARED
from ..rotations import fill_matrix, rotate_by_world_vector, rotate_unit_by_rate
from .base import (
    HEADING,
    RATE,
    RATE_VAR,
    START_HEADING_STD,
    STATIC_TURN_NOISE,
    OrientationFilter,
    bridge_rate,
    into_sensor,
    make_record,
)
from .noise import ACCEL_BIAS_STD, SWAY_CORRELATION_S


@dataclass(frozen=True)
class SmekfParams:
    """What the static phase does not say of a sensor; standard deviations."""

    tilt_std: NonNegative = ACCEL_BIAS_STD  # [rad] of roll and pitch at the start
    static_turn_noise: NonNegative = STATIC_TURN_NOISE  # [rad/√s] of undetected rotation about the vertical
    gyro_scale_std: NonNegative = 0.002  # of the gyroscope's scale, which no static phase shows
    gyro_range: PositiveOrInfinite = np.inf  # [rad/s] full scale; at it the covariance grows by what may be beyond

    def __post_init__(self) -> None:
        check_fields(self, "")


# Matrices are tuples of nine numbers, rows first: numbers stay in registers and the entries of an array would not. The
# covariance P is (P_aa, P_ab, P_bb); of P_aa and P_bb the upper triangle counts.


@inlined
def _add_product(C, A, X):  # type: ignore[no-untyped-def]
    """C + A X."""
    return (
        fma(A[0], X[0], fma(A[1], X[3], fma(A[2], X[6], C[0]))),
        fma(A[0], X[1], fma(A[1], X[4], fma(A[2], X[7], C[1]))),
        fma(A[0], X[2], fma(A[1], X[5], fma(A[2], X[8], C[2]))),
        fma(A[3], X[0], fma(A[4], X[3], fma(A[5], X[6], C[3]))),
        fma(A[3], X[1], fma(A[4], X[4], fma(A[5], X[7], C[4]))),
        fma(A[3], X[2], fma(A[4], X[5], fma(A[5], X[8], C[5]))),
        fma(A[6], X[0], fma(A[7], X[3], fma(A[8], X[6], C[6]))),
        fma(A[6], X[1], fma(A[7], X[4], fma(A[8], X[7], C[7]))),
        fma(A[6], X[2], fma(A[7], X[5], fma(A[8], X[8], C[8]))),
    )


@inlined
def _predict(state, model, lost_var):  # type: ignore[no-untyped-def]
    """Algorithm 1, prediction: F P Fᵀ + Q with F = [[I, B], [0, I]] of errors in V, B = −δt R_VS."""
    A, C, D, R, dt = state.P_aa, state.P_ab, state.P_bb, state.R_VS, -model.dt
    B = (
        dt * R[0, 0], dt * R[0, 1], dt * R[0, 2],
        dt * R[1, 0], dt * R[1, 1], dt * R[1, 2],
        dt * R[2, 0], dt * R[2, 1], dt * R[2, 2],
    )  # fmt: skip
    q, r = model.attitude_var + lost_var, model.bias_var
    aa = A[0] + q, A[1], A[2], A[3], A[4] + q, A[5], A[6], A[7], A[8] + q
    ab = C[0], C[1], C[2], C[3], C[4], C[5], C[6], C[7], C[8]
    bb = D[0], D[1], D[2], D[1], D[4], D[5], D[2], D[5], D[8]
    moved = _add_product(ab, B, bb)
    aa = _add_product(aa, B, (ab[0], ab[3], ab[6], ab[1], ab[4], ab[7], ab[2], ab[5], ab[8]))
    aa = _add_product(aa, moved, (B[0], B[3], B[6], B[1], B[4], B[7], B[2], B[5], B[8]))
    return aa, moved, (bb[0] + r, bb[1], bb[2], bb[3], bb[4] + r, bb[5], bb[6], bb[7], bb[8] + r)


@inlined
def _correct(state, model, P, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Algorithm 1, correction in a static phase, by one measurement after the other; returns P.

    y = [R_VS accel/g; gyro], h = [e_z; b̂], H = [[[e_z]×, 0], [0, I]] of errors in V. A correction of the attitude does
    not change e_z, so that P, whose long axis is the heading, need not follow it. The vertical part of accel measures
    nothing of the state.
    """
    R, bias, g, gyro_var, accel_var = (
        state.R_VS, state.gyro_bias, model.inverse_gravity, model.static_gyro_var, model.static_accel_var
    )  # fmt: skip
    force_x = g * (R[0, 0] * ax + R[0, 1] * ay + R[0, 2] * az)
    force_y = g * (R[1, 0] * ax + R[1, 1] * ay + R[1, 2] * az)
    x = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # [a; b]
    _, b, c = P
    P, x = _fuse(P, x, (b[0], b[3], b[6]), (c[0], c[1], c[2]), c[0] + gyro_var, gx - bias[0])
    _, b, c = P
    P, x = _fuse(P, x, (b[1], b[4], b[7]), (c[1], c[4], c[5]), c[4] + gyro_var, gy - bias[1] - x[4])
    _, b, c = P
    P, x = _fuse(P, x, (b[2], b[5], b[8]), (c[2], c[5], c[8]), c[8] + gyro_var, gz - bias[2] - x[5])
    a, b, _ = P
    P, x = _fuse(P, x, (a[1], a[4], a[5]), (b[3], b[4], b[5]), a[4] + accel_var, -force_x - x[1])
    a, b, _ = P
    P, x = _fuse(P, x, (a[0], a[1], a[2]), (b[0], b[1], b[2]), a[0] + accel_var, force_y - x[0])
    state.about_vertical[HEADING] += x[2]
    state.about_vertical[RATE] += R[2, 0] * x[3] + R[2, 1] * x[4] + R[2, 2] * x[5]
    bias[0] += x[3]
    bias[1] += x[4]
    bias[2] += x[5]
    rotate_by_world_vector(state.quat_VS, x[0], x[1], x[2])
    fill_matrix(state.quat_VS, R)
    a, b, c = P
    return (a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8] + model.static_turn_var), b, c


@inlined
def _fuse(P, x, a, b, variance, innovation):  # type: ignore[no-untyped-def]
    """Correct by a measurement of one state, P h = (a, b), s the variance: P ← P − P h hᵀ P/s and x ← x + P h y/s."""
    share = 1.0 / variance
    u, v = (share * a[0], share * a[1], share * a[2]), (share * b[0], share * b[1], share * b[2])
    gain = share * innovation
    P = _subtract_outer(P[0], u, a), _subtract_outer(P[1], u, b), _subtract_outer(P[2], v, b)
    return P, (
        fma(gain, a[0], x[0]), fma(gain, a[1], x[1]), fma(gain, a[2], x[2]),
        fma(gain, b[0], x[3]), fma(gain, b[1], x[4]), fma(gain, b[2], x[5]),
    )  # fmt: skip


@inlined
def _subtract_outer(C, u, v):  # type: ignore[no-untyped-def]
    """C − u vᵀ."""
    return (
        fma(-u[0], v[0], C[0]), fma(-u[0], v[1], C[1]), fma(-u[0], v[2], C[2]),
        fma(-u[1], v[0], C[3]), fma(-u[1], v[1], C[4]), fma(-u[1], v[2], C[5]),
        fma(-u[2], v[0], C[6]), fma(-u[2], v[1], C[7]), fma(-u[2], v[2], C[8]),
    )  # fmt: skip


@kernel
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    state, model = states[0], models[0]
    quat, bias, R, vertical, dt = state.quat_VS, state.gyro_bias, state.R_VS, state.about_vertical, model.dt
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        wx, wy, wz, is_measured, lost_var = bridge_rate(state, model, gx, gy, gz, bias[0], bias[1], bias[2])
        rotate_unit_by_rate(quat, wx, wy, wz, dt)
        fill_matrix(quat, R)
        P = _predict(state, model, lost_var)
        if static[k] and is_measured and ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
            P = _correct(state, model, P, gx, gy, gz, ax, ay, az)
        a, b, c = P
        for i in (0, 1, 2, 4, 5, 8):
            state.P_aa[i], state.P_bb[i] = a[i], c[i]
        for i in range(9):
            state.P_ab[i] = b[i]
        # A scale of the gyroscope that is wrong by s gives the heading an error of s times the rotation about the
        # vertical. The scale is no part of the filter's state, as in the paper.
        state.turned += dt * (R[2, 0] * wx + R[2, 1] * wy + R[2, 2] * wz)
        into_sensor(R, a, 0.0, model.scale_var * state.turned * state.turned, out_cov[k])
        x, y, z = R[2, 0], R[2, 1], R[2, 2]
        vertical[RATE_VAR] = c[0] * x * x + c[4] * y * y + c[8] * z * z
        vertical[RATE_VAR] += 2.0 * (c[1] * x * y + c[2] * x * z + c[5] * y * z)
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
        state = make_record(
            quat_VS=quat_VS,  # (4,) xyzw
            gyro_bias=noise.gyro_bias,  # (3,) [rad/s]
            # P of a in V and b in S, rows first
            P_aa=np.diag(np.square([p.tilt_std, p.tilt_std, START_HEADING_STD])).ravel(),  # [rad²]
            P_ab=np.zeros(9),  # [rad²/s]
            P_bb=noise.gyro_bias_cov.ravel(),  # [rad²/s²]
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
