"""The sMEKF as published: Algorithm 1 of Lisini Baldi et al. 2019, to the first order, as the paper writes it.

The state is x = [a; b]: the attitude error a [rad] on the right of `quat_VS`, in S, and the gyroscope bias b [rad/s].
Measurement model: gyro = ω + b + w_ω, accel/g = R_VSᵀ e_z + w_g. In a static phase ω = 0, so gyro measures b. Σ_ω and
Σ_g are the covariances of the white noises w_ω and w_g, Σ_b that of the bias's random walk. `smekf` is this filter with
an exact covariance.
"""

from __future__ import annotations

import numpy as np

from ..compilation import compiled
from ..recording.limits import HIGHEST_RATE_SQUARED
from ..rotations import rotate_by_vector, up_in_sensor
from .base import HEADING, RATE, RATE_VAR, OrientationFilter, make_record
from .noise import SensorNoise

START_VAR = 1e-3  # [rad²], [rad²/s²] P₀ of the authors' software


@compiled
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    quat, bias, P, vertical = states[0].quat_VS, states[0].gyro_bias, states[0].P, states[0].about_vertical
    dt, Q, R, identity = models[0].dt, models[0].Q, models[0].R, np.eye(6)
    F, H = np.eye(6), np.zeros((6, 6))
    F[:3, 3:], H[3:, 3:] = -dt * identity[:3, :3], identity[:3, :3]
    for k in range(len(gyro_S)):
        w, accel = gyro_S[k] - bias, accel_S[k] / models[0].gravity
        if np.sum(gyro_S[k] ** 2) < HIGHEST_RATE_SQUARED:  # false for NaN
            rotate_by_vector(quat, w[0] * dt, w[1] * dt, w[2] * dt)
            _fill_cross(F, -dt * w, 1.0)  # I − [ω δt]×
            P[:] = F @ P @ F.T + dt * dt * Q
            up = np.array(up_in_sensor(quat))
            if static[k] and np.sum(accel**2) < np.inf:
                _fill_cross(H, up, 0.0)
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                x = K @ np.concatenate((accel - up, w))
                P[:] = (identity - K @ H) @ P
                rotate_by_vector(quat, x[0], x[1], x[2])
                bias += x[3:]
                vertical[HEADING] += np.dot(up, x[:3])
                vertical[RATE] += np.dot(up, x[3:])
            vertical[RATE_VAR] = np.dot(up, np.ascontiguousarray(P[3:, 3:]) @ up)
        out_quat[k], out_bias[k], out_cov[k], out_vertical[k] = quat, bias, P[:3, :3], vertical


@compiled
def _fill_cross(A, v, diagonal):  # type: ignore[no-untyped-def]
    """Fill the upper left block of `A` with [v]× + diagonal I."""
    A[0, 0] = A[1, 1] = A[2, 2] = diagonal
    A[0, 1], A[0, 2], A[1, 0] = -v[2], v[1], v[2]
    A[1, 2], A[2, 0], A[2, 1] = -v[0], -v[1], v[0]


def _make_records(noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, params: None) -> tuple[np.ndarray, ...]:  # noqa: ARG001
    Q, R = np.zeros((6, 6)), np.zeros((6, 6))
    Q[:3, :3], Q[3:, 3:] = noise.gyro_cov, noise.bias_step_cov  # of [w_ω; w_b]
    R[:3, :3], R[3:, 3:] = noise.accel_cov, noise.gyro_cov  # of [w_g; w_ω]
    P = START_VAR * np.eye(6)
    state = make_record(quat_VS=quat_VS, gyro_bias=noise.gyro_bias, P=P, about_vertical=np.zeros(3))
    return state, make_record(dt=1.0 / rate_hz, gravity=noise.gravity, Q=Q, R=R)


# With the covariances of the authors' software, and in `sensors` with the paper's static test.
PUBLISHED_SMEKF = OrientationFilter(_make_records, _run)
