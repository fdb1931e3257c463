"""sMEKF: the multiplicative Kalman filter that corrects only at rest (Lisini Baldi 2019, Algorithm 1), nothing added.

The state is x = [a; b]: the attitude error a [rad] on the right of `quat_WS`, in the sensor frame, and the gyroscope
bias b [rad/s]. Measurement model: gyro = ω + b + w_ω, accel/g = R_WSᵀ e_z + w_g. At rest ω = 0, so gyro measures b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import BadOption
from ..noise import SensorNoise
from ..so3 import compiled, rotate_by_vector, up_in_sensor
from .base import FilterRun, samples

ACCEL_BIAS_STD = 0.003  # [rad] tilt error that a calibrated MEMS accelerometer's bias makes (3 mg: our assumption)
MOVING_TILT_STD = 0.2  # [rad] tilt error of an accelerometer in motion
HEADING_FLOOR = 1e-5  # [rad] keeps P₀ positive definite about the vertical


@dataclass(frozen=True)
class SmekfParams:
    """P₀ and Σ_b; the defaults are those of the authors' published software.

    Their P₀ gives the heading, which nothing measures, a standard deviation of 1.8 deg. With the first-order F of the
    algorithm this leaks into the tilt over a minute of motion at 100 Hz and comes back as jumps of the heading by
    degrees at the next rest; `starting_params` says what a still start is really worth. Their Σ_b is some 2 Σ_ω, orders
    above the drift of a real bias, so every rest forgets the ones before and the covariance is too large.

    By how much, over two minutes of simulated motion with rests (`tests/test_filters.py` measures it; a NEES of 3 is
    right, below is a covariance too large): NEES 1.9 and 0.57 deg of heading (rms) with the paper's P₀ and Σ_b, 1.1 and
    0.10 deg with a measured P₀, 2.2 and 0.08 deg with a measured P₀ and the Σ_b of a bias that drifts by 10 deg/h.
    """

    attitude_cov0: float | np.ndarray = 1e-3  # [rad²], a number or (3, 3) in S
    bias_cov0: float | np.ndarray = 1e-3  # [rad²/s²], a number or (3, 3)
    bias_step_cov: np.ndarray | None = None  # (3, 3) Σ_b [rad²/s²]; None: of the still phase's first differences


def starting_params(noise: SensorNoise, quat_WS: np.ndarray, still_start: bool) -> SmekfParams:
    """P₀ from what the still phase says: the tilt as good as the accelerometer, the heading exact by definition.

    Parameters
    ----------
    quat_WS : (4,) xyzw, the orientation the filter starts from
    still_start : the recording begins at rest; if not, the first tilt may be off by tens of degrees
    """
    up_S = np.array(up_in_sensor(quat_WS))
    tilt_std = ACCEL_BIAS_STD if still_start else MOVING_TILT_STD
    across = np.cross(np.eye(3), up_S)  # [up]×, up to the sign: an error of the measured vertical is one of the tilt
    measured = tilt_std**2 * np.eye(3) + noise.accel_cov * bool(still_start)
    return SmekfParams(
        attitude_cov0=across.T @ measured @ across + HEADING_FLOOR**2 * np.eye(3),
        bias_cov0=noise.gyro_bias_cov,
    )


@dataclass
class SmekfState:
    quat_WS: np.ndarray  # (4,) xyzw
    gyro_bias: np.ndarray  # (3,) [rad/s]
    P: np.ndarray  # (6, 6) covariance of [a; b]


class Smekf:
    """sMEKF of one sensor. Σ_ω, Σ_g, Σ_b, the first bias and the gravity scale come from `noise`."""

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, params: SmekfParams | None = None
    ) -> None:
        self.params = params or SmekfParams()
        self.noise = noise
        self.rate_hz = rate_hz
        P = np.zeros((6, 6))
        P[:3, :3] = _matrix(self.params.attitude_cov0)
        P[3:, 3:] = _matrix(self.params.bias_cov0)
        step = self.params.bias_step_cov
        self._bias_step_cov = noise.bias_step_cov if step is None else _matrix(step)
        self.state = SmekfState(np.array(quat_WS, dtype=float), noise.gyro_bias.copy(), P)

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool) -> FilterRun:
        gyro, accel, at_rest = samples(gyro_S, accel_S, static)
        out = FilterRun(np.empty((len(gyro), 4)), np.empty((len(gyro), 3)), np.empty((len(gyro), 3, 3)))
        state, noise = self.state, self.noise
        _run(
            state.quat_WS,
            state.gyro_bias,
            state.P,
            gyro,
            accel,
            at_rest,
            1.0 / self.rate_hz,
            noise.gravity,
            noise.gyro_cov,
            self._bias_step_cov,
            noise.accel_cov,
            *out,
        )
        return out

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: bool) -> np.ndarray:
        return self.run(gyro_S, accel_S, static).quat_WS[0]


def _matrix(cov: float | np.ndarray) -> np.ndarray:
    """A covariance (3, 3) that may be given as one variance."""
    given = np.asarray(cov, dtype=float)
    matrix = given if given.ndim == 2 else given * np.eye(3)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix)[0] < -1e-15:
        raise BadOption(f"covariance {cov!r}: a variance from 0 on is needed, or a positive semidefinite (3, 3)")
    return matrix


@compiled
def predict(quat, bias, P, gyro, dt, gyro_cov, bias_step_cov):  # type: ignore[no-untyped-def]
    """Algorithm 1, prediction: q ← q ⊗ exp((gyro − b) δt), P ← F P Fᵀ + G Q Gᵀ, block by block.

    F = [[A, −δt I], [0, I]] with A = I − δt [ω̂]×, and G Q Gᵀ = δt² diag(Σ_ω, Σ_b).
    """
    wx = (gyro[0] - bias[0]) * dt
    wy = (gyro[1] - bias[1]) * dt
    wz = (gyro[2] - bias[2]) * dt
    rotate_by_vector(quat, wx, wy, wz)
    A = np.array([[1.0, wz, -wy], [-wz, 1.0, wx], [wy, -wx, 1.0]])
    ab = np.empty((3, 3))
    half = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            s = 0.0
            for m in range(3):
                s += A[i, m] * P[m, 3 + j]
            ab[i, j] = s  # A P_ab
    for i in range(3):
        for j in range(3):
            s = 0.0
            for m in range(3):
                s += A[i, m] * P[m, j]
            half[i, j] = s  # A P_aa
    for i in range(3):
        for j in range(i, 3):
            s = -dt * (ab[i, j] + ab[j, i]) + dt * dt * (P[3 + i, 3 + j] + gyro_cov[i, j])
            for m in range(3):
                s += half[i, m] * A[j, m]
            P[i, j] = s
            P[j, i] = s
    for i in range(3):
        for j in range(3):
            P[i, 3 + j] = ab[i, j] - dt * P[3 + i, 3 + j]
            P[3 + j, i] = P[i, 3 + j]
    for i in range(3):
        for j in range(3):
            P[3 + i, 3 + j] += dt * dt * bias_step_cov[i, j]


@compiled
def correct(quat, bias, P, gyro, accel, gravity, gyro_cov, accel_cov):  # type: ignore[no-untyped-def]
    """Algorithm 1, correction at rest: y = [accel/g; gyro], h = [R_WSᵀ e_z; b̂], H = [[[R_WSᵀ e_z]×, 0], [0, I]]."""
    ux, uy, uz = up_in_sensor(quat)
    y = np.empty(6)
    y[0] = accel[0] / gravity - ux
    y[1] = accel[1] / gravity - uy
    y[2] = accel[2] / gravity - uz
    for i in range(3):
        y[3 + i] = gyro[i] - bias[i]

    HP = np.empty((6, 6))
    for j in range(6):
        HP[0, j] = uy * P[2, j] - uz * P[1, j]
        HP[1, j] = uz * P[0, j] - ux * P[2, j]
        HP[2, j] = ux * P[1, j] - uy * P[0, j]
        HP[3, j] = P[3, j]
        HP[4, j] = P[4, j]
        HP[5, j] = P[5, j]
    # S = H P Hᵀ + R, its Cholesky factor in place (lower triangle)
    S = np.zeros((6, 6))
    for i in range(6):
        S[i, 0] = HP[i, 2] * uy - HP[i, 1] * uz
        S[i, 1] = HP[i, 0] * uz - HP[i, 2] * ux
        S[i, 2] = HP[i, 1] * ux - HP[i, 0] * uy
        for j in range(3):
            S[i, 3 + j] = HP[i, 3 + j]
    for i in range(3):
        for j in range(3):
            S[i, j] += accel_cov[i, j]
            S[3 + i, 3 + j] += gyro_cov[i, j]
    for j in range(6):
        for m in range(j):
            S[j, j] -= S[j, m] * S[j, m]
        S[j, j] = np.sqrt(S[j, j])
        for i in range(j + 1, 6):
            for m in range(j):
                S[i, j] -= S[i, m] * S[j, m]
            S[i, j] /= S[j, j]
    # With S = L Lᵀ and V = L⁻¹ H P: K (y − h) = Vᵀ L⁻¹ (y − h) and (I − K H) P = P − Vᵀ V.
    for i in range(6):
        for m in range(i):
            y[i] -= S[i, m] * y[m]
            for j in range(6):
                HP[i, j] -= S[i, m] * HP[m, j]
        y[i] /= S[i, i]
        for j in range(6):
            HP[i, j] /= S[i, i]
    x = np.zeros(6)
    for i in range(6):
        for m in range(6):
            x[i] += HP[m, i] * y[m]
    for i in range(6):
        for j in range(i, 6):
            s = P[i, j]
            for m in range(6):
                s -= HP[m, i] * HP[m, j]
            P[i, j] = s
            P[j, i] = s
    rotate_by_vector(quat, x[0], x[1], x[2])
    for i in range(3):
        bias[i] += x[3 + i]


@compiled
def _run(  # type: ignore[no-untyped-def]
    quat,
    bias,
    P,
    gyro_S,
    accel_S,
    static,
    dt,
    gravity,
    gyro_cov,
    bias_step_cov,
    accel_cov,
    out_quat,
    out_bias,
    out_cov,
):
    for k in range(len(gyro_S)):
        predict(quat, bias, P, gyro_S[k], dt, gyro_cov, bias_step_cov)
        if static[k]:
            correct(quat, bias, P, gyro_S[k], accel_S[k], gravity, gyro_cov, accel_cov)
        out_quat[k] = quat
        out_bias[k] = bias
        out_cov[k] = P[:3, :3]
