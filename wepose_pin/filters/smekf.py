"""sMEKF: the multiplicative Kalman filter that corrects in static phases alone (Lisini Baldi 2019, Algorithm 1).

One thing differs from the paper, which works to first order. Its transition Φ = I − [ω δt]× lets the standard deviation
grow by √(1 + (ω δt)²) a sample, at 720 deg/s and 100 Hz to 10⁶ deg in 20 s. Its corrections rotate the attitude and not
the covariance, so that static phases seem to measure the heading. Here Φ = exp(−[ω δt]×), and a correction rotates the
covariance too. `PublishedSmekf` is the paper's, to the first order.

The state is x = [a; b]: the attitude error a [rad] on the right of `quat_WS`, in the sensor frame, and the gyroscope
bias b [rad/s]. Measurement model: gyro = ω + b + w_ω, accel/g = R_WSᵀ e_z + w_g. In a static phase ω = 0, so gyro
measures b. Σ_ω and Σ_g are the covariances of the white noises w_ω and w_g, Σ_b that of the bias's random walk, P₀ that
of the state at the first sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..compilation import inlined, kernel
from ..errors import BadOption
from ..recording.limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED
from ..rotations import rotate_by_vector, rotation_terms, up_in_sensor
from .base import (
    RATE_VAR,
    STATIC_TURN_NOISE,
    VERTICAL_COLUMNS,
    FilterRun,
    OneSample,
    add_correction,
    integrate_corrections,
    make_run,
    prepare_samples,
)
from .covariance import fill_symmetric, symmetric
from .noise import SWAY_CORRELATION_S, SensorNoise
from .start import ACCEL_BIAS_STD
from .static import static_step

GYRO_SCALE_STD = 0.002  # of a calibrated MEMS gyroscope, as in `amekf.AmekfParams.gyro_matrix_std`
HEADING_FLOOR = 1e-5  # [rad] keeps P₀ positive definite about the vertical


@dataclass(frozen=True)
class SmekfParams:
    """Covariances of the filter; the defaults are those of the authors' published software.

    Their P₀ gives the heading, which nothing measures, a standard deviation of 1.8 deg; `starting_params` takes P₀ from
    the start phase. Their Σ_b is some 2 Σ_ω, orders of magnitude above the drift of a real bias, so that each static
    phase forgets the ones before and the covariance is too large.

    Over two minutes of simulated motion with static phases (`tests/test_filters.py`) the normalised estimation error
    squared, which is 3 for a right covariance and less for one that is too large, and the rms heading error are: 1.9
    and 0.57 deg with the paper's P₀, Σ_b and first order; 0.5 and 0.10 deg exact and with `starting_params`; 0.7 and
    0.08 deg with the Σ_b of a bias that drifts by 10 deg/h as well. The simulated accelerometer has no bias and the
    gyroscope no wrong scale, which `starting_params` allows for.
    """

    attitude_cov0: float | np.ndarray = 1e-3  # [rad²], a number or (3, 3) in S
    bias_cov0: float | np.ndarray = 1e-3  # [rad²/s²], a number or (3, 3)
    bias_step_cov: np.ndarray | None = None  # (3, 3) Σ_b [rad²/s²]; None: of the static phase's first differences
    static_gyro_cov: np.ndarray | None = None  # (3, 3) [rad²/s²] of static gyro about the bias; None: Σ_ω
    static_accel_cov: np.ndarray | None = None  # (3, 3) of static accel/g about the vertical; None: Σ_g
    static_turn_noise: float = 0.0  # [rad/√s] of undetected rotation about the vertical in a static phase; the paper: 0
    gyro_scale_std: float = 0.0  # of the gyroscope's scale, which no static phase shows; the paper: 0
    gyro_range: float = np.inf  # [rad/s]; a sample at it is used, and the covariance grows by what may be beyond


def starting_params(noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, tilt_std: float) -> SmekfParams:
    """Return the parameters with P₀ of the start phase: the tilt as it is known, the heading exact by definition.

    A person's sway and the accelerometer's bias are correlated from sample to sample, while Σ_ω and Σ_g stand for white
    noise. The covariances of static samples are therefore inflated: many samples of a static phase count as few.

    Parameters
    ----------
    quat_WS : (4,) xyzw, the orientation from which the filter starts
    tilt_std : [rad] one standard deviation of its roll and pitch
    """
    up_S = np.array(up_in_sensor(quat_WS))
    across = np.eye(3) - np.outer(up_S, up_S)
    return SmekfParams(
        attitude_cov0=tilt_std**2 * across + HEADING_FLOOR**2 * np.eye(3),
        bias_cov0=noise.gyro_bias_cov,
        static_gyro_cov=noise.gyro_cov + noise.sway_density(rate_hz) * rate_hz * np.eye(3),
        static_accel_cov=noise.accel_cov + ACCEL_BIAS_STD**2 * SWAY_CORRELATION_S * rate_hz * np.eye(3),
        static_turn_noise=STATIC_TURN_NOISE,
        gyro_scale_std=GYRO_SCALE_STD,
    )


# At a missing sample (NaN, or beyond `recording.limits`) the last rate is held and fades with the time constant HOLD_S,
# no correction is made, and the attitude's standard deviation grows by the motion that may have been missed: after T
# seconds by LOST_RATE_STD T²/(T + HOLD_S), up to π.
HOLD_S = 0.1  # [s] about as long as the rate of an arm keeps its value
LOST_RATE_STD = 2.5  # [rad/s] of an arm in motion (our assumption)

# The state of a sensor is one record, its constants (the model) are another. Upper triangles are xx xy xz yy yz zz.
STATE = np.dtype(
    [
        ("quat_WS", float, 4),  # xyzw
        ("gyro_bias", float, 3),  # [rad/s]
        ("attitude_cov", float, 6),  # [rad²] upper triangle: P_aa, and what the gyroscope's scale adds to the heading
        ("turned", float),  # [rad] net rotation about the vertical since the start
        ("P_aa", float, 6),  # [rad²] upper triangle
        ("P_ab", float, (3, 3)),  # [rad²/s]
        ("P_bb", float, 6),  # [rad²/s²] upper triangle
        ("held_rate", float, 3),  # [rad/s] the last that was measured
        ("lost_s", float),  # [s] since then
        ("about_vertical", float, VERTICAL_COLUMNS),  # as `base.AboutVertical`
    ],
    align=True,
)
MODEL = np.dtype(
    [
        ("dt", float),  # [s]
        ("inverse_gravity", float),  # [s²/m]
        ("attitude_step", float, 6),  # [rad²] δt² Σ_ω
        ("bias_step", float, 6),  # [rad²/s²] δt² Σ_b
        ("static_gyro_cov", float, 6),  # [rad²/s²]
        ("static_accel_cov", float, 6),  # of accel/g
        ("fade", float),  # factor on a held rate at each missing sample
        ("first_order", np.bool_),
        ("static_turn", float),  # [rad²] variance of an undetected turn in a static sample
        ("scale_var", float),  # of the gyroscope's scale
        ("gyro_range", float),  # [rad/s]
    ],
    align=True,
)
_UPPER = np.triu_indices(3)


class SmekfState:
    """Views of the record that the compiled steps work on."""

    def __init__(self, record: np.ndarray) -> None:
        self.record = record  # (1,) of `STATE`
        self.quat_WS = record["quat_WS"][0]  # (4,) xyzw
        self.gyro_bias = record["gyro_bias"][0]  # (3,) [rad/s]

    @property
    def P(self) -> np.ndarray:
        """Covariance (6, 6) of [a; b]; a copy."""
        record = self.record[0]
        aa, bb = symmetric(record["P_aa"]), symmetric(record["P_bb"])
        return np.block([[aa, record["P_ab"]], [record["P_ab"].T, bb]])


class Smekf:
    """sMEKF of one sensor. Σ_ω, Σ_g, Σ_b, the first bias and the size of gravity come from `noise`.

    Missing samples are NaN: the last rate is held and fades, and `attitude_cov` grows by the motion that may have been
    missed (HOLD_S, LOST_RATE_STD). `run` and `update` are those of `base.OrientationFilter`.
    """

    first_order = False  # the paper's transition I − [ω δt]× in place of exp(−[ω δt]×)

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, params: SmekfParams | None = None
    ) -> None:
        self.params = params or SmekfParams()
        self.noise = noise
        self.rate_hz = rate_hz
        self.model = _model(noise, 1.0 / rate_hz, self.params, self.first_order)
        record = np.zeros(1, STATE)
        record["quat_WS"], record["gyro_bias"] = quat_WS, noise.gyro_bias
        record["P_aa"] = record["attitude_cov"] = _matrix(self.params.attitude_cov0)[_UPPER]
        record["P_bb"] = _matrix(self.params.bias_cov0)[_UPPER]
        record["about_vertical"][0, RATE_VAR] = float(np.trace(_matrix(self.params.bias_cov0))) / 3.0
        self.state = SmekfState(record)
        self._one = OneSample()

    @property
    def bank_kernel(self) -> Callable[..., None]:
        """The kernel that steps many sensors at a time (`bank.LiveBank`)."""
        return _step_bank

    def run(
        self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool, out: FilterRun | None = None
    ) -> FilterRun:
        gyro, accel, is_static = prepare_samples(gyro_S, accel_S, static)
        out = out or make_run(len(gyro))
        _run(self.state.record, self.model, gyro, accel, is_static, *out)
        return out

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: bool) -> np.ndarray:
        one = self._one
        sample = one.fill(gyro_S, accel_S, static)
        out = one.quat_WS, one.gyro_bias, one.attitude_cov, one.about_vertical
        _run(self.state.record, self.model, *sample, *out)
        return one.quat_WS[0].copy()


class PublishedSmekf(Smekf):
    """sMEKF as published: transition and corrections of the covariance to the first order.

    `filters.SensorRun` gives it the paper's static test too.
    """

    first_order = True


def _matrix(cov: float | np.ndarray) -> np.ndarray:
    """A covariance (3, 3) that may be given as one variance."""
    array = np.asarray(cov, dtype=float)
    if array.ndim == 0 and 0.0 <= array < np.inf:
        return array * np.eye(3)
    matrix = array if array.ndim == 2 else array * np.eye(3)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix)[0] < -1e-15:
        raise BadOption(f"covariance {cov!r}: a variance from 0 on is needed, or a positive semidefinite (3, 3)")
    return matrix


def _model(noise: SensorNoise, dt: float, params: SmekfParams, first_order: bool) -> np.ndarray:
    """Return the constants of a sensor's filter, (1,) of `MODEL`."""

    def upper(cov: np.ndarray | None, default: np.ndarray) -> np.ndarray:
        return (default if cov is None else _matrix(cov))[_UPPER]

    model = np.zeros(1, MODEL)
    model["dt"], model["inverse_gravity"] = dt, 1.0 / noise.gravity
    model["attitude_step"] = (dt * dt * noise.gyro_cov)[_UPPER]
    model["bias_step"] = dt * dt * upper(params.bias_step_cov, noise.bias_step_cov)
    model["static_gyro_cov"] = upper(params.static_gyro_cov, noise.gyro_cov)
    model["static_accel_cov"] = upper(params.static_accel_cov, noise.accel_cov)
    model["fade"], model["first_order"] = np.exp(-dt / HOLD_S), first_order
    model["static_turn"], model["gyro_range"] = params.static_turn_noise**2 * dt, params.gyro_range
    model["scale_var"] = params.gyro_scale_std**2
    return model


@inlined
def step(state, model, gx, gy, gz, ax, ay, az, static):  # type: ignore[no-untyped-def]
    """Take one sample of one sensor: records of `STATE` and `MODEL`, gyro [rad/s], accel [m/s²]."""
    dt, bias, held = model.dt, state.gyro_bias, state.held_rate
    integrate_corrections(state.about_vertical, dt)
    is_measured = gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED  # false for NaN
    lost_var = 0.0
    if is_measured:
        wx, wy, wz = gx - bias[0], gy - bias[1], gz - bias[2]
    else:
        wx, wy, wz = model.fade * held[0], model.fade * held[1], model.fade * held[2]
    if is_measured and max(abs(gx), abs(gy), abs(gz)) < model.gyro_range:
        state.lost_s = 0.0
    else:
        before, after = state.lost_s, state.lost_s + dt
        std_before = min(np.pi, LOST_RATE_STD * before * before / (before + HOLD_S))
        std_after = min(np.pi, LOST_RATE_STD * after * after / (after + HOLD_S))
        lost_var = std_after * std_after - std_before * std_before
        state.lost_s = after
    held[0], held[1], held[2] = wx, wy, wz
    predict(state, model, wx * dt, wy * dt, wz * dt, lost_var)
    if static and is_measured and ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
        correct(state, model, gx, gy, gz, ax, ay, az)
    update_attitude_cov(state, model, wx * dt, wy * dt, wz * dt)


@inlined
def update_attitude_cov(state, model, wx, wy, wz):  # type: ignore[no-untyped-def]
    """Set the stated attitude covariance after the rotation w [rad]: P_aa and the error of the gyroscope's scale.

    A scale that is wrong by s gives the heading an error of s times the rotation about the vertical. It gives the tilt
    an error too, which static phases correct. The scale is no part of the filter's state, as in the paper.
    """
    ux, uy, uz = up_in_sensor(state.quat_WS)
    state.turned += wx * ux + wy * uy + wz * uz
    heading_var = model.scale_var * state.turned * state.turned
    cov, P_aa = state.attitude_cov, state.P_aa
    cov[0] = P_aa[0] + heading_var * ux * ux
    cov[1] = P_aa[1] + heading_var * ux * uy
    cov[2] = P_aa[2] + heading_var * ux * uz
    cov[3] = P_aa[3] + heading_var * uy * uy
    cov[4] = P_aa[4] + heading_var * uy * uz
    cov[5] = P_aa[5] + heading_var * uz * uz
    state.about_vertical[RATE_VAR] = compute_variance_along(state.P_bb, ux, uy, uz)


@inlined
def predict(state, model, wx, wy, wz, lost_var):  # type: ignore[no-untyped-def]
    """Algorithm 1, prediction by the turn w = (gyro − b) δt: q ← q ⊗ exp(w), P ← F P Fᵀ + G Q Gᵀ.

    G Q Gᵀ = δt² diag(Σ_ω, Σ_b). `lost_var` [rad²] is added on top.
    """
    rotate_by_vector(state.quat_WS, wx, wy, wz)
    propagate(state, wx, wy, wz, model.dt, model.first_order)
    P_aa, P_bb = state.P_aa, state.P_bb
    for i in range(6):
        diagonal = i == 0 or i == 3 or i == 5
        P_aa[i] += model.attitude_step[i] + lost_var if diagonal else model.attitude_step[i]
        P_bb[i] += model.bias_step[i]


# 3×3 matrices in the kernels below are nine numbers, rows first, so that they stay in registers.


@inlined
def full(upper):  # type: ignore[no-untyped-def]
    """The symmetric matrix of an upper triangle (6,)."""
    return upper[0], upper[1], upper[2], upper[1], upper[3], upper[4], upper[2], upper[4], upper[5]


@inlined
def nine(matrix):  # type: ignore[no-untyped-def]
    """A matrix (3, 3)."""
    a, b, c = matrix[0], matrix[1], matrix[2]
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@inlined
def transposed(A):  # type: ignore[no-untyped-def]
    return A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8]


@inlined
def products(A, X, B, Y):  # type: ignore[no-untyped-def]
    """A X + B Y."""
    return (
        A[0] * X[0] + A[1] * X[3] + A[2] * X[6] + B[0] * Y[0] + B[1] * Y[3] + B[2] * Y[6],
        A[0] * X[1] + A[1] * X[4] + A[2] * X[7] + B[0] * Y[1] + B[1] * Y[4] + B[2] * Y[7],
        A[0] * X[2] + A[1] * X[5] + A[2] * X[8] + B[0] * Y[2] + B[1] * Y[5] + B[2] * Y[8],
        A[3] * X[0] + A[4] * X[3] + A[5] * X[6] + B[3] * Y[0] + B[4] * Y[3] + B[5] * Y[6],
        A[3] * X[1] + A[4] * X[4] + A[5] * X[7] + B[3] * Y[1] + B[4] * Y[4] + B[5] * Y[7],
        A[3] * X[2] + A[4] * X[5] + A[5] * X[8] + B[3] * Y[2] + B[4] * Y[5] + B[5] * Y[8],
        A[6] * X[0] + A[7] * X[3] + A[8] * X[6] + B[6] * Y[0] + B[7] * Y[3] + B[8] * Y[6],
        A[6] * X[1] + A[7] * X[4] + A[8] * X[7] + B[6] * Y[1] + B[7] * Y[4] + B[8] * Y[7],
        A[6] * X[2] + A[7] * X[5] + A[8] * X[8] + B[6] * Y[2] + B[7] * Y[5] + B[8] * Y[8],
    )


@inlined
def transition(wx, wy, wz, dt, first_order):  # type: ignore[no-untyped-def]
    """A and B of F = [[A, B], [0, I]] over the turn w [rad] in δt [s].

    A = exp(−[w]×) and B = −δt ∫₀¹ exp(−[w]× u) du; to first order, as the paper writes it, A = I − [w]×, B = −δt I.
    """
    cosine, s, c, d = 1.0, 1.0, 0.0, 0.0
    e = 1.0  # B's share of I, s where A's is cos θ
    if not first_order:
        cosine, s, c, d = rotation_terms(wx * wx + wy * wy + wz * wz)
        e = s
    # A = cos θ I − s [w]× + c w wᵀ
    xy, xz, yz = c * wx * wy, c * wx * wz, c * wy * wz
    ux, uy, uz = s * wx, s * wy, s * wz
    A = (
        cosine + c * wx * wx, xy + uz, xz - uy,
        xy - uz, cosine + c * wy * wy, yz + ux,
        xz + uy, yz - ux, cosine + c * wz * wz,
    )  # fmt: skip
    # B = −δt (s I − c [w]× + d w wᵀ)
    d, ux, uy, uz = -dt * d, -dt * c * wx, -dt * c * wy, -dt * c * wz
    xy, xz, yz = d * wx * wy, d * wx * wz, d * wy * wz
    B = (
        d * wx * wx - dt * e, xy + uz, xz - uy,
        xy - uz, d * wy * wy - dt * e, yz + ux,
        xz + uy, yz - ux, d * wz * wz - dt * e,
    )  # fmt: skip
    return A, B


@inlined
def propagate(state, wx, wy, wz, dt, first_order):  # type: ignore[no-untyped-def]
    """P ← F P Fᵀ over the turn w [rad] in δt [s], block by block."""
    A, B = transition(wx, wy, wz, dt, first_order)
    P_aa, P_ab, P_bb = full(state.P_aa), nine(state.P_ab), full(state.P_bb)
    new_ab = products(A, P_ab, B, P_bb)
    new_aa = products(products(A, P_aa, B, transposed(P_ab)), transposed(A), new_ab, transposed(B))
    fill_blocks(state, new_aa, new_ab)


@inlined
def product(A, X):  # type: ignore[no-untyped-def]
    """A X."""
    return (
        A[0] * X[0] + A[1] * X[3] + A[2] * X[6],
        A[0] * X[1] + A[1] * X[4] + A[2] * X[7],
        A[0] * X[2] + A[1] * X[5] + A[2] * X[8],
        A[3] * X[0] + A[4] * X[3] + A[5] * X[6],
        A[3] * X[1] + A[4] * X[4] + A[5] * X[7],
        A[3] * X[2] + A[4] * X[5] + A[5] * X[8],
        A[6] * X[0] + A[7] * X[3] + A[8] * X[6],
        A[6] * X[1] + A[7] * X[4] + A[8] * X[7],
        A[6] * X[2] + A[7] * X[5] + A[8] * X[8],
    )


@inlined
def rotate_covariance(state, wx, wy, wz):  # type: ignore[no-untyped-def]
    """P ← F P Fᵀ over the turn w [rad] in no time: B is zero."""
    A, _ = transition(wx, wy, wz, 0.0, False)
    fill_blocks(state, product(product(A, full(state.P_aa)), transposed(A)), product(A, nine(state.P_ab)))


@inlined
def fill_blocks(state, aa, ab):  # type: ignore[no-untyped-def]
    """Set P_aa and P_ab to matrices of nine numbers."""
    upper, across = state.P_aa, state.P_ab
    upper[0], upper[1], upper[2], upper[3], upper[4], upper[5] = aa[0], aa[1], aa[2], aa[4], aa[5], aa[8]
    across[0, 0], across[0, 1], across[0, 2] = ab[0], ab[1], ab[2]
    across[1, 0], across[1, 1], across[1, 2] = ab[3], ab[4], ab[5]
    across[2, 0], across[2, 1], across[2, 2] = ab[6], ab[7], ab[8]


@inlined
def correct(state, model, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Algorithm 1, correction in a static phase.

    y = [accel/g; gyro], h = [R_WSᵀ e_z; b̂], H = [[[R_WSᵀ e_z]×, 0], [0, I]].

    The noises of the two are independent, so gyro is taken first and accel after it, which is the same correction with
    two S of (3, 3) in place of one of (6, 6).
    """
    bias, P_aa, P_bb = state.gyro_bias, state.P_aa, state.P_bb
    ux, uy, uz = up_in_sensor(state.quat_WS)
    before = compute_variance_along(P_bb, ux, uy, uz)
    # gyro: H P = [P_ba, P_bb], S = P_bb + Σ_ω
    R = model.static_gyro_cov
    b, c = nine(state.P_ab), full(P_bb)
    S = P_bb[0] + R[0], P_bb[1] + R[1], P_bb[2] + R[2], P_bb[3] + R[3], P_bb[4] + R[4], P_bb[5] + R[5]
    rows = (
        (b[0], b[3], b[6], c[0], c[1], c[2]),
        (b[1], b[4], b[7], c[3], c[4], c[5]),
        (b[2], b[5], b[8], c[6], c[7], c[8]),
    )
    d = fuse(state, rows, S, (gx - bias[0], gy - bias[1], gz - bias[2]))
    # accel: H P = [u]× [P_aa, P_ab], S = [u]× P_aa [u]×ᵀ + Σ_g; what gyro said of the attitude is off the innovation
    R = model.static_accel_cov
    g = model.inverse_gravity
    innovation = (
        ax * g - ux - (uy * d[2] - uz * d[1]),
        ay * g - uy - (uz * d[0] - ux * d[2]),
        az * g - uz - (ux * d[1] - uy * d[0]),
    )
    a, b = full(P_aa), nine(state.P_ab)
    x, y = (a[0], a[1], a[2], b[0], b[1], b[2]), (a[3], a[4], a[5], b[3], b[4], b[5])
    z = a[6], a[7], a[8], b[6], b[7], b[8]
    row0, row1, row2 = difference(uy, z, uz, y), difference(uz, x, ux, z), difference(ux, y, uy, x)
    S = (
        row0[2] * uy - row0[1] * uz + R[0],
        row0[0] * uz - row0[2] * ux + R[1],
        row0[1] * ux - row0[0] * uy + R[2],
        row1[0] * uz - row1[2] * ux + R[3],
        row1[1] * ux - row1[0] * uy + R[4],
        row2[1] * ux - row2[0] * uy + R[5],
    )
    e = fuse(state, (row0, row1, row2), S, innovation)
    turn = d[0] + e[0], d[1] + e[1], d[2] + e[2]
    rotate_by_vector(state.quat_WS, turn[0], turn[1], turn[2])
    if not model.first_order:
        # The direction of the vertical in S changes with the correction. The long axis of P, the heading, has to follow
        # it: otherwise it would have a horizontal part, which the next sample of accel would correct.
        rotate_covariance(state, turn[0], turn[1], turn[2])
    for i in range(3):
        bias[i] += d[3 + i] + e[3 + i]
    heading, rate = (
        ux * turn[0] + uy * turn[1] + uz * turn[2],
        ux * (d[3] + e[3]) + uy * (d[4] + e[4]) + uz * (d[5] + e[5]),
    )
    add_correction(state.about_vertical, heading, rate, before, compute_variance_along(P_bb, ux, uy, uz))
    tx, ty, tz = model.static_turn * ux, model.static_turn * uy, model.static_turn * uz
    P_aa[0] += tx * ux
    P_aa[1] += tx * uy
    P_aa[2] += tx * uz
    P_aa[3] += ty * uy
    P_aa[4] += ty * uz
    P_aa[5] += tz * uz


@inlined
def compute_variance_along(P, ux, uy, uz):  # type: ignore[no-untyped-def]
    """Compute uᵀ P u of an upper triangle (6,)."""
    x, y, z = P[0] * ux + P[1] * uy + P[2] * uz, P[1] * ux + P[3] * uy + P[4] * uz, P[2] * ux + P[4] * uy + P[5] * uz
    return x * ux + y * uy + z * uz


@inlined
def difference(a, x, b, y):  # type: ignore[no-untyped-def]
    """a x − b y of six numbers each."""
    return (
        a * x[0] - b * y[0], a * x[1] - b * y[1], a * x[2] - b * y[2],
        a * x[3] - b * y[3], a * x[4] - b * y[4], a * x[5] - b * y[5],
    )  # fmt: skip


@inlined
def fuse(state, rows, S, innovation):  # type: ignore[no-untyped-def]
    """Correct by three measurements: P ← P − (H P)ᵀ S⁻¹ (H P); return the error state (6,) (H P)ᵀ S⁻¹ (y − h).

    With S = L D Lᵀ and V = L⁻¹ H P these are P − Vᵀ D⁻¹ V and Vᵀ D⁻¹ L⁻¹ (y − h). `rows` are those of H P (3, 6), S is
    its upper triangle, `innovation` is y − h. A direction in which S is zero corrects nothing.
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
    a = rows[0]
    b = difference(1.0, rows[1], l10, a)
    c = difference(1.0, difference(1.0, rows[2], l20, a), l21, b)
    P_aa, P_ab, P_bb = state.P_aa, state.P_ab, state.P_bb

    p, q, r = i0 * a[0], i1 * b[0], i2 * c[0]
    P_aa[0] -= p * a[0] + q * b[0] + r * c[0]
    P_aa[1] -= p * a[1] + q * b[1] + r * c[1]
    P_aa[2] -= p * a[2] + q * b[2] + r * c[2]
    P_ab[0, 0] -= p * a[3] + q * b[3] + r * c[3]
    P_ab[0, 1] -= p * a[4] + q * b[4] + r * c[4]
    P_ab[0, 2] -= p * a[5] + q * b[5] + r * c[5]
    g0 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a[1], i1 * b[1], i2 * c[1]
    P_aa[3] -= p * a[1] + q * b[1] + r * c[1]
    P_aa[4] -= p * a[2] + q * b[2] + r * c[2]
    P_ab[1, 0] -= p * a[3] + q * b[3] + r * c[3]
    P_ab[1, 1] -= p * a[4] + q * b[4] + r * c[4]
    P_ab[1, 2] -= p * a[5] + q * b[5] + r * c[5]
    g1 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a[2], i1 * b[2], i2 * c[2]
    P_aa[5] -= p * a[2] + q * b[2] + r * c[2]
    P_ab[2, 0] -= p * a[3] + q * b[3] + r * c[3]
    P_ab[2, 1] -= p * a[4] + q * b[4] + r * c[4]
    P_ab[2, 2] -= p * a[5] + q * b[5] + r * c[5]
    g2 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a[3], i1 * b[3], i2 * c[3]
    P_bb[0] -= p * a[3] + q * b[3] + r * c[3]
    P_bb[1] -= p * a[4] + q * b[4] + r * c[4]
    P_bb[2] -= p * a[5] + q * b[5] + r * c[5]
    g3 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a[4], i1 * b[4], i2 * c[4]
    P_bb[3] -= p * a[4] + q * b[4] + r * c[4]
    P_bb[4] -= p * a[5] + q * b[5] + r * c[5]
    g4 = p * e0 + q * e1 + r * e2
    p, q, r = i0 * a[5], i1 * b[5], i2 * c[5]
    P_bb[5] -= p * a[5] + q * b[5] + r * c[5]
    g5 = p * e0 + q * e1 + r * e2
    return g0, g1, g2, g3, g4, g5


@kernel
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    state, model = states[0], models[0]
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        step(state, model, gx, gy, gz, accel_S[k, 0], accel_S[k, 1], accel_S[k, 2], static[k])
        for i in range(4):
            out_quat[k, i] = state.quat_WS[i]
        for i in range(VERTICAL_COLUMNS):
            out_vertical[k, i] = state.about_vertical[i]
        for i in range(3):
            out_bias[k, i] = state.gyro_bias[i]
        fill_symmetric(state.attitude_cov, out_cov[k])


@kernel
def _step_bank(states, models, detectors, block, tail, gyro_S, accel_S, static):  # type: ignore[no-untyped-def]
    """One sample of each of k sensors, detector and filter; arrays with a row a sensor, as `bank.LiveBank` has them."""
    for i in range(len(states)):
        gx, gy, gz = gyro_S[i, 0], gyro_S[i, 1], gyro_S[i, 2]
        ax, ay, az = accel_S[i, 0], accel_S[i, 1], accel_S[i, 2]
        static[i] = static_step(detectors[i], block[i], tail[i], gx, gy, gz, ax, ay, az)
        step(states[i], models[i], gx, gy, gz, ax, ay, az, static[i])
