"""sMEKF: the multiplicative Kalman filter that corrects only at rest (Lisini Baldi 2019, Algorithm 1).

One thing differs from the paper, which works to first order: its transition Φ = I − [ω δt]× lets the covariance grow by
√(1 + (ω δt)²) a sample, at 720 deg/s and 100 Hz to 10⁶ deg in 20 s, and leaves it as it is where a correction turns
the attitude, so that rests seem to measure the heading. Here Φ = exp(−[ω δt]×), and the covariance turns with the
correction; `SmekfParams.first_order` is the paper's.

The state is x = [a; b]: the attitude error a [rad] on the right of `quat_WS`, in the sensor frame, and the gyroscope
bias b [rad/s]. Measurement model: gyro = ω + b + w_ω, accel/g = R_WSᵀ e_z + w_g. At rest ω = 0, so gyro measures b.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..compilation import inlined, kernel
from ..errors import BadOption
from ..recording.limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED
from ..rotations import rotate_by_vector, rotation_terms, up_in_sensor
from .base import REST_TURN_NOISE, FilterRun, OneSample, samples
from .noise import SWAY_CORRELATION_S, SensorNoise
from .start import ACCEL_BIAS_STD
from .static import static_step

HEADING_FLOOR = 1e-5  # [rad] keeps P₀ positive definite about the vertical


@dataclass(frozen=True)
class SmekfParams:
    """P₀ and Σ_b; the defaults are those of the authors' published software.

    Their P₀ gives the heading, which nothing measures, a standard deviation of 1.8 deg. `starting_params` says what a
    still start is really worth. Their Σ_b is some 2 Σ_ω, orders above the drift of a real bias, so every rest forgets
    the ones before and the covariance is too large.

    By how much, over two minutes of simulated motion with rests (`tests/test_filters.py` measures it; a NEES of 3 is
    right, below is a covariance too large): NEES 1.9 and 0.57 deg of heading (rms) with the paper's P₀, Σ_b and first
    order, 0.5 and 0.10 deg exact and with `starting_params`, 0.8 and 0.08 deg with the Σ_b of a bias that drifts by
    10 deg/h as well. The simulated accelerometer has no bias, which `starting_params` allows for.
    """

    attitude_cov0: float | np.ndarray = 1e-3  # [rad²], a number or (3, 3) in S
    bias_cov0: float | np.ndarray = 1e-3  # [rad²/s²], a number or (3, 3)
    bias_step_cov: np.ndarray | None = None  # (3, 3) Σ_b [rad²/s²]; None: of the static phase's first differences
    rest_gyro_cov: np.ndarray | None = None  # (3, 3) [rad²/s²] by which gyro at rest is not the bias; None: Σ_ω
    rest_accel_cov: np.ndarray | None = None  # (3, 3) by which accel/g at rest is not the vertical; None: Σ_g
    rest_turn_noise: float = 0.0  # [rad/√s] by which a sensor at rest may turn about the vertical unseen; the paper: 0
    first_order: bool = False  # the paper's transition I − [ω δt]× in place of exp(−[ω δt]×)
    gyro_range: float = np.inf  # [rad/s]; a sample at it is cut off: turned by it, but what is beyond went unseen


def starting_params(noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, tilt_std: float) -> SmekfParams:
    """P₀ from what the start phase says: the tilt as good as it is known, the heading exact by definition.

    A person's sway goes on from sample to sample, where Σ_ω and Σ_g are taken for white, and so does the bias of the
    accelerometer: what gyro says of its bias at rest, and accel of the vertical, counts as little as that allows.

    Parameters
    ----------
    quat_WS : (4,) xyzw, the orientation the filter starts from
    tilt_std : [rad] one standard deviation of its roll and pitch
    """
    up_S = np.array(up_in_sensor(quat_WS))
    across = np.eye(3) - np.outer(up_S, up_S)
    return SmekfParams(
        attitude_cov0=tilt_std**2 * across + HEADING_FLOOR**2 * np.eye(3),
        bias_cov0=noise.gyro_bias_cov,
        rest_gyro_cov=noise.gyro_cov + noise.sway_density(rate_hz) * rate_hz * np.eye(3),
        rest_accel_cov=noise.accel_cov + ACCEL_BIAS_STD**2 * SWAY_CORRELATION_S * rate_hz * np.eye(3),
        rest_turn_noise=REST_TURN_NOISE,
    )


# At a missing sample (`recording.limits`) the last rate is held and fades away with HOLD_S, the correction is left out,
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
        self.model = _model(noise, 1.0 / rate_hz, self.params)
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


def _model(noise: SensorNoise, dt: float, params: SmekfParams) -> np.ndarray:
    """(30,): δt, 1/g, δt² Σ_ω, δt² Σ_b, gyro's at rest, Σ_g as upper triangles, what is left of a held rate after a
    sample, whether the transition is of first order, variance of an unseen turn in a sample at rest,
    the gyroscope's range."""
    step, rest = params.bias_step_cov, params.rest_gyro_cov
    bias_step_cov = noise.bias_step_cov if step is None else _matrix(step)
    rest_gyro_cov = noise.gyro_cov if rest is None else _matrix(rest)
    accel = params.rest_accel_cov
    rest_accel_cov = noise.accel_cov if accel is None else _matrix(accel)
    covs = dt * dt * noise.gyro_cov, dt * dt * bias_step_cov, rest_gyro_cov, rest_accel_cov
    ends = [np.exp(-dt / HOLD_S), float(params.first_order), params.rest_turn_noise**2 * dt, params.gyro_range]
    return np.concatenate([[dt, 1.0 / noise.gravity], *(cov[_UPPER] for cov in covs), ends])


@inlined
def step(x, model, gx, gy, gz, ax, ay, az, static):  # type: ignore[no-untyped-def]
    """One sample of one sensor: `x` (32,) its state, `model` (30,), gyro [rad/s], accel [m/s²]."""
    dt = model[0]
    seen = gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED  # false for NaN
    unseen_cov = 0.0
    if seen:
        wx, wy, wz = gx - x[4], gy - x[5], gz - x[6]
    else:
        wx, wy, wz = model[26] * x[28], model[26] * x[29], model[26] * x[30]
    if seen and max(abs(gx), abs(gy), abs(gz)) < model[29]:
        x[31] = 0.0
    else:
        before, after = x[31], x[31] + dt
        std_before = min(np.pi, UNSEEN_RATE_STD * before * before / (before + HOLD_S))
        std_after = min(np.pi, UNSEEN_RATE_STD * after * after / (after + HOLD_S))
        unseen_cov = std_after * std_after - std_before * std_before
        x[31] = after
    x[28], x[29], x[30] = wx, wy, wz
    predict(x, model, wx * dt, wy * dt, wz * dt, unseen_cov)
    if static and seen and ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
        correct(x, model, gx, gy, gz, ax, ay, az)


@inlined
def predict(x, model, wx, wy, wz, unseen_cov):  # type: ignore[no-untyped-def]
    """Algorithm 1, prediction by the turn w = (gyro − b) δt: q ← q ⊗ exp(w), P ← F P Fᵀ + G Q Gᵀ.

    G Q Gᵀ = δt² diag(Σ_ω, Σ_b). `unseen_cov` [rad²] is added on top.
    """
    rotate_by_vector(x, wx, wy, wz)
    carry(x, wx, wy, wz, model[0], model[27] != 0.0)
    x[7] += model[2] + unseen_cov
    x[8] += model[3]
    x[9] += model[4]
    x[10] += model[5] + unseen_cov
    x[11] += model[6]
    x[12] += model[7] + unseen_cov
    x[22] += model[8]
    x[23] += model[9]
    x[24] += model[10]
    x[25] += model[11]
    x[26] += model[12]
    x[27] += model[13]


@inlined
def carry(x, wx, wy, wz, dt, first_order):  # type: ignore[no-untyped-def]
    """P ← F P Fᵀ over the turn w [rad] in δt [s], block by block.

    F = [[A, B], [0, I]] with A = exp(−[w]×) and B = −δt ∫₀¹ exp(−[w]× u) du; to first order, as the paper writes it,
    A = I − [w]× and B = −δt I.
    """
    cosine, s, c, d = 1.0, 1.0, 0.0, 0.0
    e = 1.0  # B's share of I, s where A's is cos θ
    if not first_order:
        cosine, s, c, d = rotation_terms(wx * wx + wy * wy + wz * wz)
        e = s
    # A = cos θ I − s [w]× + c w wᵀ
    xy, xz, yz = c * wx * wy, c * wx * wz, c * wy * wz
    ux, uy, uz = s * wx, s * wy, s * wz
    A00, A01, A02 = cosine + c * wx * wx, xy + uz, xz - uy
    A10, A11, A12 = xy - uz, cosine + c * wy * wy, yz + ux
    A20, A21, A22 = xz + uy, yz - ux, cosine + c * wz * wz
    # B = −δt (s I − c [w]× + d w wᵀ)
    d, ux, uy, uz = -dt * d, -dt * c * wx, -dt * c * wy, -dt * c * wz
    xy, xz, yz = d * wx * wy, d * wx * wz, d * wy * wz
    B00, B01, B02 = d * wx * wx - dt * e, xy + uz, xz - uy
    B10, B11, B12 = xy - uz, d * wy * wy - dt * e, yz + ux
    B20, B21, B22 = xz + uy, yz - ux, d * wz * wz - dt * e
    axx, axy, axz, ayy, ayz, azz = x[7], x[8], x[9], x[10], x[11], x[12]
    bxx, bxy, bxz, byx, byy, byz, bzx, bzy, bzz = x[13], x[14], x[15], x[16], x[17], x[18], x[19], x[20], x[21]
    cxx, cxy, cxz, cyy, cyz, czz = x[22], x[23], x[24], x[25], x[26], x[27]
    # M = A P_ab + B P_bb, the new P_ab
    M00 = A00 * bxx + A01 * byx + A02 * bzx + B00 * cxx + B01 * cxy + B02 * cxz
    M01 = A00 * bxy + A01 * byy + A02 * bzy + B00 * cxy + B01 * cyy + B02 * cyz
    M02 = A00 * bxz + A01 * byz + A02 * bzz + B00 * cxz + B01 * cyz + B02 * czz
    M10 = A10 * bxx + A11 * byx + A12 * bzx + B10 * cxx + B11 * cxy + B12 * cxz
    M11 = A10 * bxy + A11 * byy + A12 * bzy + B10 * cxy + B11 * cyy + B12 * cyz
    M12 = A10 * bxz + A11 * byz + A12 * bzz + B10 * cxz + B11 * cyz + B12 * czz
    M20 = A20 * bxx + A21 * byx + A22 * bzx + B20 * cxx + B21 * cxy + B22 * cxz
    M21 = A20 * bxy + A21 * byy + A22 * bzy + B20 * cxy + B21 * cyy + B22 * cyz
    M22 = A20 * bxz + A21 * byz + A22 * bzz + B20 * cxz + B21 * cyz + B22 * czz
    # N = A P_aa + B P_ba
    N00 = A00 * axx + A01 * axy + A02 * axz + B00 * bxx + B01 * bxy + B02 * bxz
    N01 = A00 * axy + A01 * ayy + A02 * ayz + B00 * byx + B01 * byy + B02 * byz
    N02 = A00 * axz + A01 * ayz + A02 * azz + B00 * bzx + B01 * bzy + B02 * bzz
    N10 = A10 * axx + A11 * axy + A12 * axz + B10 * bxx + B11 * bxy + B12 * bxz
    N11 = A10 * axy + A11 * ayy + A12 * ayz + B10 * byx + B11 * byy + B12 * byz
    N12 = A10 * axz + A11 * ayz + A12 * azz + B10 * bzx + B11 * bzy + B12 * bzz
    N20 = A20 * axx + A21 * axy + A22 * axz + B20 * bxx + B21 * bxy + B22 * bxz
    N21 = A20 * axy + A21 * ayy + A22 * ayz + B20 * byx + B21 * byy + B22 * byz
    N22 = A20 * axz + A21 * ayz + A22 * azz + B20 * bzx + B21 * bzy + B22 * bzz
    # N Aᵀ + M Bᵀ, the new P_aa
    x[7] = N00 * A00 + N01 * A01 + N02 * A02 + M00 * B00 + M01 * B01 + M02 * B02
    x[8] = N00 * A10 + N01 * A11 + N02 * A12 + M00 * B10 + M01 * B11 + M02 * B12
    x[9] = N00 * A20 + N01 * A21 + N02 * A22 + M00 * B20 + M01 * B21 + M02 * B22
    x[10] = N10 * A10 + N11 * A11 + N12 * A12 + M10 * B10 + M11 * B11 + M12 * B12
    x[11] = N10 * A20 + N11 * A21 + N12 * A22 + M10 * B20 + M11 * B21 + M12 * B22
    x[12] = N20 * A20 + N21 * A21 + N22 * A22 + M20 * B20 + M21 * B21 + M22 * B22
    x[13], x[14], x[15] = M00, M01, M02
    x[16], x[17], x[18] = M10, M11, M12
    x[19], x[20], x[21] = M20, M21, M22


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
    if model[27] == 0.0:
        # The vertical, which accel does not measure about, turns in S with the correction, and P with it: left as it
        # was, P would lie askew and the next sample would take its long axis for one that accel measures.
        carry(x, d[0] + e[0], d[1] + e[1], d[2] + e[2], 0.0, False)
    x[4] += d[3] + e[3]
    x[5] += d[4] + e[4]
    x[6] += d[5] + e[5]
    tx, ty, tz = model[28] * ux, model[28] * uy, model[28] * uz
    x[7] += tx * ux
    x[8] += tx * uy
    x[9] += tx * uz
    x[10] += ty * uy
    x[11] += ty * uz
    x[12] += tz * uz


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
    rows, models, block, tail, head, anchor, counts, limits, bias, gyro_S, accel_S, static
):
    """One sample of each of k sensors, detector and filter; arrays with a row a sensor, as `bank.LiveBank` has them."""
    for i in range(len(rows)):
        gx, gy, gz = gyro_S[i, 0], gyro_S[i, 1], gyro_S[i, 2]
        ax, ay, az = accel_S[i, 0], accel_S[i, 1], accel_S[i, 2]
        still = static_step(
            block[i], tail[i], head[i], anchor[i], counts[i], limits[i], bias[i], gx, gy, gz, ax, ay, az
        )
        static[i] = still
        step(rows[i], models[i], gx, gy, gz, ax, ay, az, still)
