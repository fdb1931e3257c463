"""sMEKF: the multiplicative Kalman filter that corrects only at rest (Lisini Baldi 2019, Algorithm 1), nothing added.

The state is x = [a; b]: the attitude error a [rad] on the right of `quat_WS`, in the sensor frame, and the gyroscope
bias b [rad/s]. Measurement model: gyro = ω + b + w_ω, accel/g = R_WSᵀ e_z + w_g. At rest ω = 0, so gyro measures b.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import BadOption
from ..noise import SensorNoise
from ..so3 import inlined, kernel, rotate_by_vector, up_in_sensor
from ..static import static_step
from .base import HIGHEST_ACCEL, HIGHEST_RATE, FilterRun, OneSample, samples

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
    gyro_range: float = np.inf  # [rad/s]; a sample at it is cut off: turned by it, but what is beyond went unseen


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


# At a missing sample (base.HIGHEST_RATE) the last rate is held and fades away with HOLD_S, the correction is left out,
# and the attitude is trusted less by the motion that may have gone unseen: after T seconds σ T²/(T + HOLD_S), up to π.
HOLD_S = 0.1  # [s] about as long as the rate of an arm keeps its value
UNSEEN_RATE_STD = 2.5  # [rad/s] of an arm in motion (our assumption)

# The state of a sensor is one row of numbers: quat_WS xyzw, bias [rad/s], the upper triangle of P by blocks, rate last
# seen [rad/s], time [s] since then. What does not change is another: `_model`.
QUAT, BIAS, P_AA, P_AB, P_BB, RATE, UNSEEN, STATE_SIZE = 0, 4, 7, 13, 22, 28, 31, 32
_UPPER = np.triu_indices(3)


class SmekfState:
    """Views of the row of numbers that the compiled steps work on."""

    def __init__(self, row: np.ndarray) -> None:
        self.row = row  # (32,)
        self.quat_WS = row[QUAT : QUAT + 4]  # (4,) xyzw
        self.gyro_bias = row[BIAS : BIAS + 3]  # (3,) [rad/s]

    @property
    def P(self) -> np.ndarray:
        """Covariance (6, 6) of [a; b]; a copy."""
        P = np.empty((6, 6))
        P[:3, :3] = symmetric(self.row[P_AA:P_AB])
        P[:3, 3:] = self.row[P_AB:P_BB].reshape(3, 3)
        P[3:, :3] = P[:3, 3:].T
        P[3:, 3:] = symmetric(self.row[P_BB:RATE])
        return P


def symmetric(upper: np.ndarray) -> np.ndarray:
    """Matrices (…, 3, 3) from their upper triangles (…, 6): xx xy xz yy yz zz."""
    return upper[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


class Smekf:
    """sMEKF of one sensor. Σ_ω, Σ_g, Σ_b, the first bias and the gravity scale come from `noise`.

    A sample that is no number does not stay in the state: the last rate is held for a tenth of a second and fades, and
    `attitude_cov` grows by the motion that may have gone unseen (HOLD_S, UNSEEN_RATE_STD).
    """

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, params: SmekfParams | None = None
    ) -> None:
        self.params = params or SmekfParams()
        self.noise = noise
        self.rate_hz = rate_hz
        step = self.params.bias_step_cov
        self.model = _model(
            noise, 1.0 / rate_hz, noise.bias_step_cov if step is None else _matrix(step), self.params.gyro_range
        )
        row = np.zeros(STATE_SIZE)
        row[QUAT:BIAS], row[BIAS:P_AA] = quat_WS, noise.gyro_bias
        row[P_AA:P_AB] = _matrix(self.params.attitude_cov0)[_UPPER]
        row[P_BB:RATE] = _matrix(self.params.bias_cov0)[_UPPER]
        self.state = SmekfState(row)
        self._one = OneSample()

    @property
    def live(self) -> Callable[..., None]:
        """The kernel that steps many sensors at a time (`bank.LiveBank`)."""
        return _live

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool) -> FilterRun:
        gyro, accel, at_rest = samples(gyro_S, accel_S, static)
        out = FilterRun(np.empty((len(gyro), 4)), np.empty((len(gyro), 3)), np.empty((len(gyro), 3, 3)))
        _run(self.state.row, self.model, gyro, accel, at_rest, *out)
        return out

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: bool) -> np.ndarray:
        one = self._one
        sample = one.fill(gyro_S, accel_S, static)
        _run(self.state.row, self.model, *sample, one.quat_WS, one.gyro_bias, one.attitude_cov)
        return one.quat_WS[0].copy()


def _matrix(cov: float | np.ndarray) -> np.ndarray:
    """A covariance (3, 3) that may be given as one variance."""
    given = np.asarray(cov, dtype=float)
    matrix = given if given.ndim == 2 else given * np.eye(3)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix)[0] < -1e-15:
        raise BadOption(f"covariance {cov!r}: a variance from 0 on is needed, or a positive semidefinite (3, 3)")
    return matrix


def _model(noise: SensorNoise, dt: float, bias_step_cov: np.ndarray, gyro_range: float) -> np.ndarray:
    """(28,): δt, 1/g, δt² Σ_ω, δt² Σ_b, Σ_ω, Σ_g as upper triangles, what is left of a held rate after one, range."""
    left = [np.exp(-dt / HOLD_S)]
    covs = dt * dt * noise.gyro_cov, dt * dt * bias_step_cov, noise.gyro_cov, noise.accel_cov
    return np.concatenate([[dt, 1.0 / noise.gravity], *(cov[_UPPER] for cov in covs), left, [gyro_range]])


@inlined
def step(x, model, gx, gy, gz, ax, ay, az, static):  # type: ignore[no-untyped-def]
    """One sample of one sensor: `x` (32,) its state, `model` (28,), gyro [rad/s], accel [m/s²]."""
    dt = model[0]
    seen = gx * gx + gy * gy + gz * gz < HIGHEST_RATE * HIGHEST_RATE  # false for NaN
    unseen_cov = 0.0
    if seen:
        wx, wy, wz = gx - x[4], gy - x[5], gz - x[6]
    else:
        wx, wy, wz = model[26] * x[28], model[26] * x[29], model[26] * x[30]
    if seen and max(abs(gx), abs(gy), abs(gz)) < model[27]:
        x[31] = 0.0
    else:
        before, after = x[31], x[31] + dt
        std_before = min(np.pi, UNSEEN_RATE_STD * before * before / (before + HOLD_S))
        std_after = min(np.pi, UNSEEN_RATE_STD * after * after / (after + HOLD_S))
        unseen_cov = std_after * std_after - std_before * std_before
        x[31] = after
    x[28], x[29], x[30] = wx, wy, wz
    predict(x, model, wx * dt, wy * dt, wz * dt, unseen_cov)
    if static and seen and ax * ax + ay * ay + az * az < HIGHEST_ACCEL * HIGHEST_ACCEL:
        correct(x, model, gx, gy, gz, ax, ay, az)


@inlined
def predict(x, model, wx, wy, wz, unseen_cov):  # type: ignore[no-untyped-def]
    """Algorithm 1, prediction by the turn w = (gyro − b) δt: q ← q ⊗ exp(w), P ← F P Fᵀ + G Q Gᵀ, block by block.

    F = [[A, −δt I], [0, I]] with A = I − [w]×, and G Q Gᵀ = δt² diag(Σ_ω, Σ_b). `unseen_cov` [rad²] is added on top.
    """
    rotate_by_vector(x, wx, wy, wz)
    dt = model[0]
    axx, axy, axz, ayy, ayz, azz = x[7], x[8], x[9], x[10], x[11], x[12]
    bxx, bxy, bxz, byx, byy, byz, bzx, bzy, bzz = x[13], x[14], x[15], x[16], x[17], x[18], x[19], x[20], x[21]
    cxx, cxy, cxz, cyy, cyz, czz = x[22], x[23], x[24], x[25], x[26], x[27]
    # A P_ab
    mxx, mxy, mxz = bxx + wz * byx - wy * bzx, bxy + wz * byy - wy * bzy, bxz + wz * byz - wy * bzz
    myx, myy, myz = byx - wz * bxx + wx * bzx, byy - wz * bxy + wx * bzy, byz - wz * bxz + wx * bzz
    mzx, mzy, mzz = bzx + wy * bxx - wx * byx, bzy + wy * bxy - wx * byy, bzz + wy * bxz - wx * byz
    # A P_aa
    nxx, nxy, nxz = axx + wz * axy - wy * axz, axy + wz * ayy - wy * ayz, axz + wz * ayz - wy * azz
    nyx, nyy, nyz = axy - wz * axx + wx * axz, ayy - wz * axy + wx * ayz, ayz - wz * axz + wx * azz
    nzx, nzy, nzz = axz + wy * axx - wx * axy, ayz + wy * axy - wx * ayy, azz + wy * axz - wx * ayz
    # A P_aa Aᵀ − δt (A P_ab + its transpose) + δt² (P_bb + Σ_ω)
    x[7] = (nxx + wz * nxy - wy * nxz) - dt * (mxx + mxx) + (dt * dt * cxx + model[2]) + unseen_cov
    x[8] = (nxy - wz * nxx + wx * nxz) - dt * (mxy + myx) + (dt * dt * cxy + model[3])
    x[9] = (nxz + wy * nxx - wx * nxy) - dt * (mxz + mzx) + (dt * dt * cxz + model[4])
    x[10] = (nyy - wz * nyx + wx * nyz) - dt * (myy + myy) + (dt * dt * cyy + model[5]) + unseen_cov
    x[11] = (nyz + wy * nyx - wx * nyy) - dt * (myz + mzy) + (dt * dt * cyz + model[6])
    x[12] = (nzz + wy * nzx - wx * nzy) - dt * (mzz + mzz) + (dt * dt * czz + model[7]) + unseen_cov
    # A P_ab − δt P_bb
    x[13], x[14], x[15] = mxx - dt * cxx, mxy - dt * cxy, mxz - dt * cxz
    x[16], x[17], x[18] = myx - dt * cxy, myy - dt * cyy, myz - dt * cyz
    x[19], x[20], x[21] = mzx - dt * cxz, mzy - dt * cyz, mzz - dt * czz
    x[22], x[23], x[24] = cxx + model[8], cxy + model[9], cxz + model[10]
    x[25], x[26], x[27] = cyy + model[11], cyz + model[12], czz + model[13]


@inlined
def correct(x, model, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Algorithm 1, correction at rest: y = [accel/g; gyro], h = [R_WSᵀ e_z; b̂], H = [[[R_WSᵀ e_z]×, 0], [0, I]].

    The noises of the two are independent, so gyro is taken first and accel after it, which is the same correction with
    two S of (3, 3) in place of one of (6, 6).
    """
    ux, uy, uz = up_in_sensor(x)
    # gyro: H P = [P_ba, P_bb], S = P_bb + Σ_ω
    innovation = gx - x[4], gy - x[5], gz - x[6]
    S = x[22] + model[14], x[23] + model[15], x[24] + model[16], x[25] + model[17], x[26] + model[18], x[27] + model[19]
    row0 = x[13], x[16], x[19], x[22], x[23], x[24]
    row1 = x[14], x[17], x[20], x[23], x[25], x[26]
    row2 = x[15], x[18], x[21], x[24], x[26], x[27]
    d = fuse(x, row0, row1, row2, S, innovation)
    # accel: H P = [u]× [P_aa, P_ab], S = [u]× P_aa [u]×ᵀ + Σ_g; what gyro said of the attitude is off the innovation
    innovation = (
        ax * model[1] - ux - (uy * d[2] - uz * d[1]),
        ay * model[1] - uy - (uz * d[0] - ux * d[2]),
        az * model[1] - uz - (ux * d[1] - uy * d[0]),
    )
    ex, ey, ez = (x[7], x[8], x[9]), (x[8], x[10], x[11]), (x[9], x[11], x[12])
    fx, fy, fz = (x[13], x[14], x[15]), (x[16], x[17], x[18]), (x[19], x[20], x[21])
    row0 = (
        uy * ez[0] - uz * ey[0],
        uy * ez[1] - uz * ey[1],
        uy * ez[2] - uz * ey[2],
        uy * fz[0] - uz * fy[0],
        uy * fz[1] - uz * fy[1],
        uy * fz[2] - uz * fy[2],
    )
    row1 = (
        uz * ex[0] - ux * ez[0],
        uz * ex[1] - ux * ez[1],
        uz * ex[2] - ux * ez[2],
        uz * fx[0] - ux * fz[0],
        uz * fx[1] - ux * fz[1],
        uz * fx[2] - ux * fz[2],
    )
    row2 = (
        ux * ey[0] - uy * ex[0],
        ux * ey[1] - uy * ex[1],
        ux * ey[2] - uy * ex[2],
        ux * fy[0] - uy * fx[0],
        ux * fy[1] - uy * fx[1],
        ux * fy[2] - uy * fx[2],
    )
    S = (
        row0[2] * uy - row0[1] * uz + model[20],
        row0[0] * uz - row0[2] * ux + model[21],
        row0[1] * ux - row0[0] * uy + model[22],
        row1[0] * uz - row1[2] * ux + model[23],
        row1[1] * ux - row1[0] * uy + model[24],
        row2[1] * ux - row2[0] * uy + model[25],
    )
    e = fuse(x, row0, row1, row2, S, innovation)
    rotate_by_vector(x, d[0] + e[0], d[1] + e[1], d[2] + e[2])
    x[4] += d[3] + e[3]
    x[5] += d[4] + e[4]
    x[6] += d[5] + e[5]


@inlined
def fuse(x, row0, row1, row2, S, innovation):  # type: ignore[no-untyped-def]
    """Three measurements: P ← P − (H P)ᵀ S⁻¹ (H P) in the state; gives the error state (6,) (H P)ᵀ S⁻¹ (y − h).

    With S = L D Lᵀ and V = L⁻¹ H P these are P − Vᵀ D⁻¹ V and Vᵀ D⁻¹ L⁻¹ (y − h). `row0` … are H P (3, 6), S its upper
    triangle. A direction without any variance, of P and of the noise, says nothing and is left out.
    """
    i0 = 1.0 / S[0] if S[0] > 0.0 else 0.0
    l10, l20 = S[1] * i0, S[2] * i0
    d1, t21 = S[3] - l10 * S[1], S[4] - l20 * S[1]
    i1 = 1.0 / d1 if d1 > 0.0 else 0.0
    l21 = t21 * i1
    d2 = S[5] - l20 * S[2] - l21 * t21
    i2 = 1.0 / d2 if d2 > 0.0 else 0.0
    e0 = innovation[0]
    e1 = innovation[1] - l10 * e0
    e2 = innovation[2] - l20 * e0 - l21 * e1

    a0, a1, a2, a3, a4, a5 = row0
    b0, b1, b2 = row1[0] - l10 * a0, row1[1] - l10 * a1, row1[2] - l10 * a2
    b3, b4, b5 = row1[3] - l10 * a3, row1[4] - l10 * a4, row1[5] - l10 * a5
    c0, c1, c2 = row2[0] - l20 * a0 - l21 * b0, row2[1] - l20 * a1 - l21 * b1, row2[2] - l20 * a2 - l21 * b2
    c3, c4, c5 = row2[3] - l20 * a3 - l21 * b3, row2[4] - l20 * a4 - l21 * b4, row2[5] - l20 * a5 - l21 * b5

    p, q, r = i0 * a0, i1 * b0, i2 * c0
    x[7] -= p * a0 + q * b0 + r * c0
    x[8] -= p * a1 + q * b1 + r * c1
    x[9] -= p * a2 + q * b2 + r * c2
    x[13] -= p * a3 + q * b3 + r * c3
    x[14] -= p * a4 + q * b4 + r * c4
    x[15] -= p * a5 + q * b5 + r * c5
    g0 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a1, i1 * b1, i2 * c1
    x[10] -= p * a1 + q * b1 + r * c1
    x[11] -= p * a2 + q * b2 + r * c2
    x[16] -= p * a3 + q * b3 + r * c3
    x[17] -= p * a4 + q * b4 + r * c4
    x[18] -= p * a5 + q * b5 + r * c5
    g1 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a2, i1 * b2, i2 * c2
    x[12] -= p * a2 + q * b2 + r * c2
    x[19] -= p * a3 + q * b3 + r * c3
    x[20] -= p * a4 + q * b4 + r * c4
    x[21] -= p * a5 + q * b5 + r * c5
    g2 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a3, i1 * b3, i2 * c3
    x[22] -= p * a3 + q * b3 + r * c3
    x[23] -= p * a4 + q * b4 + r * c4
    x[24] -= p * a5 + q * b5 + r * c5
    g3 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a4, i1 * b4, i2 * c4
    x[25] -= p * a4 + q * b4 + r * c4
    x[26] -= p * a5 + q * b5 + r * c5
    g4 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a5, i1 * b5, i2 * c5
    x[27] -= p * a5 + q * b5 + r * c5
    g5 = p * e0 + q * e1 + r * e2
    return g0, g1, g2, g3, g4, g5


@kernel
def _run(x, model, gyro_S, accel_S, static, out_quat, out_bias, out_cov):  # type: ignore[no-untyped-def]
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        step(x, model, gx, gy, gz, accel_S[k, 0], accel_S[k, 1], accel_S[k, 2], static[k])
        for i in range(4):
            out_quat[k, i] = x[i]
        for i in range(3):
            out_bias[k, i] = x[4 + i]
        out_cov[k, 0, 0], out_cov[k, 1, 1], out_cov[k, 2, 2] = x[7], x[10], x[12]
        out_cov[k, 0, 1], out_cov[k, 0, 2], out_cov[k, 1, 2] = x[8], x[9], x[11]
        out_cov[k, 1, 0], out_cov[k, 2, 0], out_cov[k, 2, 1] = x[8], x[9], x[11]


@kernel
def _live(  # type: ignore[no-untyped-def]
    rows, models, block, tail, head, anchor, counts, limits, gyro_S, accel_S, static
):
    """One sample of each of k sensors, detector and filter; arrays with a row a sensor, as `bank.LiveBank` has them."""
    for i in range(len(rows)):
        gx, gy, gz = gyro_S[i, 0], gyro_S[i, 1], gyro_S[i, 2]
        ax, ay, az = accel_S[i, 0], accel_S[i, 1], accel_S[i, 2]
        still = static_step(block[i], tail[i], head[i], anchor[i], counts[i], limits[i], gx, gy, gz, ax, ay, az)
        static[i] = still
        step(rows[i], models[i], gx, gy, gz, ax, ay, az, still)
