"""sMEKF: the multiplicative Kalman filter that corrects in static phases alone (Lisini Baldi 2019, Algorithm 1).

Two things differ from the paper, which works to first order (`_run_published`). Its transition Φ = I − [ω δt]× lets the
standard deviation grow by √(1 + (ω δt)²) a sample, at 720 deg/s and 100 Hz to 10⁶ deg in 20 s. Its corrections rotate
the attitude and not the covariance, so that static phases seem to measure the heading. Over two minutes of simulated
motion with static phases the rms heading error is 0.57 deg as published and 0.10 deg here.

What static phases do not show of the gyroscope, its scale and misalignment, adds to the noise in motion.

The state is x = [a; b]: the attitude error a [rad] and the gyroscope bias b [rad/s] in S. The paper's a is in S, on the
right of `quat_VS`. Here it is in V, on the left, where neither the sensor's rotation nor a correction of the attitude
changes it: Φ is the identity and P need not be rotated.

Measurement model: gyro = ω + b + w_ω, accel/g = R_VSᵀ e_z + w_g. In a static phase ω = 0, so gyro measures b. The white
noises w_ω, w_g and the bias's random walk have one variance on all axes, the mean of those of Σ_ω, Σ_g and Σ_b. A
person's sway and the accelerometer's bias are correlated from sample to sample, so that the variances of static samples
are inflated: many samples of a static phase count as few.
"""

from dataclasses import dataclass

import numpy as np

from ..arguments import NonNegative, PositiveOrInfinite
from ..compilation import compiled, fma, inlined, kernel
from ..recording.limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED
from ..rotations import fill_matrix, rotate_by_vector, rotate_by_world_vector, up_in_sensor
from . import base
from .phases import ACCEL_BIAS_STD, SWAY_CORRELATION_S, SensorNoise, average_variance


@dataclass(frozen=True)
class SmekfParams(base.FilterParams):
    """What the static phase does not say of a sensor; standard deviations."""

    tilt_std: NonNegative = ACCEL_BIAS_STD  # [rad] of roll and pitch at the start
    static_turn_noise: NonNegative = base.STATIC_TURN_NOISE  # [rad/√s] of undetected rotation about the vertical
    gyro_scale_std: NonNegative = 0.002  # of the gyroscope's scale, which no static phase shows
    rate_noise: NonNegative = 2e-3  # [1/√Hz] of gyro in motion, a fraction of |ω|
    drift_rate_std: NonNegative = base.DRIFT_RATE_STD  # [rad/s] of the heading in motion, apart from the bias
    gyro_range: PositiveOrInfinite = np.inf  # [rad/s] full scale; at it the covariance grows by what may be beyond


# P = [[A, C], [Cᵀ, B]] of errors a in V and b in S. A matrix (3, 3) is nine floats, rows first, which stay in
# the processor's registers; what is not read of a product is not computed.


@inlined
def _read(row):  # type: ignore[no-untyped-def]
    return row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8]


@inlined
def _add_scaled(a, s, v):  # type: ignore[no-untyped-def]
    """``a + s v`` of three floats each."""
    return fma(s, v[0], a[0]), fma(s, v[1], a[1]), fma(s, v[2], a[2])


@inlined
def _add_outer(A, u, v):  # type: ignore[no-untyped-def]
    """``A + u vᵀ``."""
    return _add_scaled(A[0:3], u[0], v) + _add_scaled(A[3:6], u[1], v) + _add_scaled(A[6:9], u[2], v)


@inlined
def _add_product(A, B, C):  # type: ignore[no-untyped-def]
    """``A + B C``: a column of B times a row of C for each."""
    A = _add_outer(A, (B[2], B[5], B[8]), C[6:9])
    A = _add_outer(A, (B[1], B[4], B[7]), C[3:6])
    return _add_outer(A, (B[0], B[3], B[6]), C[0:3])


@inlined
def _transpose(A):  # type: ignore[no-untyped-def]
    return A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8]


@inlined
def _symmetric(A):  # type: ignore[no-untyped-def]
    """``A`` by its upper half."""
    return A[0], A[1], A[2], A[1], A[4], A[5], A[2], A[5], A[8]


@inlined
def _add_diagonal(A, x, y, z):  # type: ignore[no-untyped-def]
    return A[0] + x, A[1], A[2], A[3], A[4] + y, A[5], A[6], A[7], A[8] + z


@inlined
def _scale(s, u):  # type: ignore[no-untyped-def]
    return s * u[0], s * u[1], s * u[2]


@inlined
def _predict(A, C, B, R, wx, wy, wz, model):  # type: ignore[no-untyped-def]
    """Algorithm 1, prediction: P ← F P Fᵀ + Q with F = [[I, −δt R_VS], [0, I]]."""
    F = _scale(-model.dt, R[0]) + _scale(-model.dt, R[1]) + _scale(-model.dt, R[2])
    A = _add_product(A, F, _transpose(C))
    C = _add_product(C, F, B)
    A = _symmetric(_add_product(A, C, _transpose(F)))
    more, more_bias = fma(model.rate_noise_var, wx * wx + wy * wy + wz * wz, model.attitude_var), model.bias_var
    return _add_diagonal(A, more, more, more), C, _add_diagonal(B, more_bias, more_bias, more_bias)


@inlined
def _fuse(A, C, B, a, b, p, c, innovation, share):  # type: ignore[no-untyped-def]
    """Correct by a measurement of one state, of covariances p, c with a, b: P ← P − [p; c] [p; c]ᵀ/s; `share`: 1/s."""
    gain, u, w = share * innovation, _scale(-share, p), _scale(-share, c)
    A, C, B = _symmetric(_add_outer(A, u, p)), _add_outer(C, u, c), _symmetric(_add_outer(B, w, c))
    return A, C, B, _add_scaled(a, gain, p), _add_scaled(b, gain, c)


@inlined
def _correct(A, C, B, state, model, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Algorithm 1, correction in a static phase, by one measurement after the other.

    y = [R_VS accel/g; gyro], h = [e_z; b̂], H = [[[e_z]×, 0], [0, I]] of errors in V. A correction of the attitude does
    not change e_z, so that P, whose long axis is the heading, need not follow it. The vertical part of accel measures
    nothing of the state.
    """
    R, bias, g, s, v = state.R_VS, state.gyro_bias, model.inverse_gravity, model.static_gyro_var, model.static_accel_var
    a, b = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    # The variance of each innovation given those before is a ratio of minors of B + s I: no division waits for another.
    first, second, third, xy, xz, yz = B[0] + s, B[4] + s, B[8] + s, B[1], B[2], B[5]
    minor = first * second - xy * xy
    determinant = minor * third - first * yz * yz + xz * (2.0 * xy * yz - second * xz)
    A, C, B, a, b = _fuse(A, C, B, a, b, (C[0], C[3], C[6]), B[0:3], gx - bias[0], 1.0 / first)
    A, C, B, a, b = _fuse(A, C, B, a, b, (C[1], C[4], C[7]), B[3:6], gy - bias[1] - b[1], first / minor)
    A, C, B, a, b = _fuse(A, C, B, a, b, (C[2], C[5], C[8]), B[6:9], gz - bias[2] - b[2], minor / determinant)
    x, y = g * (R[0, 0] * ax + R[0, 1] * ay + R[0, 2] * az), g * (R[1, 0] * ax + R[1, 1] * ay + R[1, 2] * az)
    A, C, B, a, b = _fuse(A, C, B, a, b, A[3:6], C[3:6], -x - a[1], 1.0 / (A[4] + v))
    A, C, B, a, b = _fuse(A, C, B, a, b, A[0:3], C[0:3], y - a[0], 1.0 / (A[0] + v))
    state.about_vertical[base.HEADING] += a[2]
    for i in range(3):
        state.about_vertical[base.RATE] += R[2, i] * b[i]
        bias[i] += b[i]
    rotate_by_world_vector(state.quat_VS, a[0], a[1], a[2])
    fill_matrix(state.quat_VS, R)
    return A[0:8] + (A[8] + model.static_turn_var,), C, B


@kernel
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    state, model = states[0], models[0]
    quat, bias, R, P, vertical = state.quat_VS, state.gyro_bias, state.R_VS, state.P, state.about_vertical
    dt = model.dt
    A, C, B = _read(P[0]), _read(P[1]), _read(P[2])
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        wx, wy, wz, is_measured, lost_var = base.bridge_rate(state, model, gx, gy, gz, bias[0], bias[1], bias[2])
        rotate_by_vector(quat, wx * dt, wy * dt, wz * dt)
        fill_matrix(quat, R)
        A, C, B = _predict(A, C, B, R, wx, wy, wz, model)
        if lost_var > 0.0:
            x, y, z = base.add_lost(A[0], lost_var), base.add_lost(A[4], lost_var), base.add_lost(A[8], lost_var)
            A = x, A[1], A[2], A[3], y, A[5], A[6], A[7], z
        if static[k] and is_measured and ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
            A, C, B = _correct(A, C, B, state, model, gx, gy, gz, ax, ay, az)
        # A scale of the gyroscope that is wrong by s gives the heading an error of s times the rotation about the
        # vertical. The scale is no part of the filter's state, as in the paper.
        state.turned += dt * (R[2, 0] * wx + R[2, 1] * wy + R[2, 2] * wz)
        state.moved_s += dt * (not static[k])
        base.into_sensor(R, A, 0.0, model.scale_var * state.turned**2 + model.drift_var * state.moved_s**2, out_cov[k])
        x, y, z = R[2, 0], R[2, 1], R[2, 2]
        vertical[base.RATE_VAR] = fma(x, fma(B[0], x, 2.0 * fma(B[1], y, B[2] * z)), y * fma(B[4], y, 2.0 * B[5] * z))
        vertical[base.RATE_VAR] += B[8] * z * z
        for i in range(3):
            out_bias[k, i], out_vertical[k, i] = bias[i], vertical[i]
        for i in range(4):
            out_quat[k, i] = quat[i]
    for i in range(9):
        P[0, i], P[1, i], P[2, i] = A[i], C[i], B[i]


def _make_records(noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, p: SmekfParams) -> tuple[np.ndarray, ...]:
    P = np.zeros((3, 9))
    P[0, [0, 4, 8]] = np.square([p.tilt_std, p.tilt_std, base.START_HEADING_STD])
    P[2] = noise.gyro_bias_cov.ravel()
    state = base.make_record(
        quat_VS=quat_VS,  # (4,) xyzw
        gyro_bias=noise.gyro_bias,  # (3,) [rad/s]
        P=P,  # A, C, B of a in V [rad] and b in S [rad/s]
        turned=0.0,  # [rad] net rotation about the vertical since the start
        moved_s=0.0,  # [s] in motion since the start
        last_rate=np.zeros(3),  # [rad/s] as `bridge_rate`
        lost_s=0.0,  # [s] the same
        about_vertical=np.array([0.0, 0.0, average_variance(noise.gyro_bias_cov)]),  # as `Orientation`
        R_VS=np.zeros((3, 3)),
    )
    covs = noise.gyro_cov, noise.accel_cov, noise.bias_step_cov
    gyro_var, accel_var, step_var = map(average_variance, covs)
    model = base.make_record(
        dt=1.0 / rate_hz,  # [s]
        inverse_gravity=1.0 / noise.gravity,  # [s²/m]
        attitude_var=gyro_var / rate_hz**2,  # [rad²] of a sample
        rate_noise_var=p.rate_noise**2 / rate_hz,  # [s²] of a sample
        bias_var=step_var / rate_hz**2,  # [rad²/s²] of a sample
        static_gyro_var=gyro_var + noise.sway_density(rate_hz) * rate_hz,  # [rad²/s²]
        static_accel_var=accel_var + ACCEL_BIAS_STD**2 * SWAY_CORRELATION_S * rate_hz,  # [1]
        static_turn_var=p.static_turn_noise**2 / rate_hz,  # [rad²] of a sample
        scale_var=p.gyro_scale_std**2,
        drift_var=p.drift_rate_std**2,  # [rad²/s²]
        gyro_range=p.gyro_range,  # [rad/s]
    )
    return state, model


SMEKF = base.OrientationFilter(_make_records, _run, SmekfParams)


# As published, to first order, with a on the right of `quat_VS`, in S ------------------------------------------------

START_VAR = 1e-3  # [rad²], [rad²/s²] P₀ of the authors' software


@compiled
def _run_published(states, models, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    quat, bias, P, vertical = states[0].quat_VS, states[0].gyro_bias, states[0].P, states[0].about_vertical
    dt, Q, R, identity = models[0].dt, models[0].Q, models[0].R, np.eye(6)
    axes, F, H = np.eye(3), np.eye(6), np.zeros((6, 6))
    F[:3, 3:], H[3:, 3:] = -dt * axes, axes
    for k in range(len(gyro_S)):
        w, accel = gyro_S[k] - bias, accel_S[k] / models[0].gravity
        if np.sum(gyro_S[k] ** 2) < HIGHEST_RATE_SQUARED:  # false for NaN
            rotate_by_vector(quat, w[0] * dt, w[1] * dt, w[2] * dt)
            F[:3, :3] = axes - np.cross(axes, dt * w)  # I − [ω δt]×
            P[:] = F @ P @ F.T + dt * dt * Q
            up = np.array(up_in_sensor(quat))
            if static[k] and np.sum(accel**2) < np.inf:
                H[:3, :3] = np.cross(axes, up)  # [up]×
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                x = K @ np.concatenate((accel - up, w))
                P[:] = (identity - K @ H) @ P
                rotate_by_vector(quat, x[0], x[1], x[2])
                bias += x[3:]
                vertical[base.HEADING] += np.dot(up, x[:3])
                vertical[base.RATE] += np.dot(up, x[3:])
            vertical[base.RATE_VAR] = np.dot(up, np.ascontiguousarray(P[3:, 3:]) @ up)
        out_quat[k], out_bias[k], out_cov[k], out_vertical[k] = quat, bias, P[:3, :3], vertical


def _make_published_records(noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, _: None) -> tuple[np.ndarray, ...]:
    Q, R = np.zeros((6, 6)), np.zeros((6, 6))
    Q[:3, :3], Q[3:, 3:] = noise.gyro_cov, noise.bias_step_cov  # of [w_ω; w_b]
    R[:3, :3], R[3:, 3:] = noise.accel_cov, noise.gyro_cov  # of [w_g; w_ω]
    P = START_VAR * np.eye(6)
    state = base.make_record(quat_VS=quat_VS, gyro_bias=noise.gyro_bias, P=P, about_vertical=np.zeros(3))
    return state, base.make_record(dt=1.0 / rate_hz, gravity=noise.gravity, Q=Q, R=R)


# With the covariances of the authors' software, and in `sensors` with the paper's static test.
PUBLISHED_SMEKF = base.OrientationFilter(_make_published_records, _run_published)
